"""Frictional contact: what is refused, and what does not converge and says so."""

from dataclasses import replace

import numpy as np
import pytest
from paraboloid_contact import SIDE_M, hertz_load, paraboloid

NAN = np.nan


def test_shear_that_friction_cannot_hold_is_refused():
    load, mu = hertz_load(0.5), 0.5
    contact = paraboloid(32, mu, 0.5)
    with pytest.raises(ValueError, match=r"shear load is .*must be below friction coefficient x normal load"):
        contact.step(contact.apart, load_newton=[0.6 * mu * load, 0.8 * mu * load, load])
    pressed = contact.step(contact.apart, load_newton=[0.0, 0.0, load])
    with pytest.raises(ValueError, match="prescribe shift_m instead"):
        contact.step(pressed, load_newton=[0, 1.01 * mu * load, NAN], shift_m=[NAN, NAN, pressed.shift_m[2]])
    with pytest.raises(ValueError, match=r"shear load is 0.01 N, must be below .* = 0 N"):
        contact.step(pressed, load_newton=[0, 0.01, NAN], shift_m=[NAN, NAN, -1e-4])


@pytest.mark.parametrize(
    ("load", "shift", "message"),
    [
        ([0, 0, 1.0], [NAN, NAN, 1e-4], "in each direction"),
        ([0, 1.0], NAN, r"load_newton has shape \(2,\)"),
        ([0, np.inf, 1.0], NAN, "load_newton is .*finite"),
    ],
)
def test_step_of_the_wrong_kind_is_refused(load: object, shift: object, message: str):
    contact = paraboloid(8, 0.5, 0.5)
    with pytest.raises(ValueError, match=message):
        contact.step(contact.apart, load_newton=load, shift_m=shift)


def test_contact_of_the_wrong_kind_is_refused():
    contact = paraboloid(8, 0.5, 0.5)
    with pytest.raises(ValueError, match=r"profile_m has shape \(8, 7\), must be \(8, 8\)"):
        replace(contact, profile_m=np.zeros((8, 7)))
    for height_m in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="profile_m"):
            replace(contact, profile_m=np.full((8, 8), height_m))
    for mu in (-0.1, 1e-7, np.nan, np.inf):
        with pytest.raises(ValueError, match=r"friction_coefficient is .*at least 1e-06"):
            replace(contact, friction_coefficient=mu)
    for tolerance in (0.0, -1.0, 1.0, np.nan):
        with pytest.raises(ValueError, match="tolerance is"):
            replace(contact, tolerance=tolerance)
    with pytest.raises(ValueError, match=r"before is a state of \(16, 16\) pixels, must be of \(8, 8\)"):
        contact.step(paraboloid(16, 0.5, 0.5).apart, load_newton=[0, 0, 1.0])


def test_contact_that_shear_spreads_to_the_border_is_refused():
    load = hertz_load(0.0, 0.4 * SIDE_M)
    contact = paraboloid(16, 1.0, 0.0)
    contact.step(contact.apart, load_newton=[0, 0, load])
    with pytest.raises(ValueError, match="contact touches the border of the height map"):
        contact.step(contact.apart, load_newton=[0.95 * load, 0, load])
