"""Frictional contact: what is refused, and what does not converge and says so."""

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


def test_contact_that_shear_spreads_to_the_border_is_refused():
    load = hertz_load(0.0, 0.4 * SIDE_M)
    contact = paraboloid(16, 1.0, 0.0)
    contact.step(contact.apart, load_newton=[0, 0, load])
    with pytest.raises(ValueError, match="contact touches the border of the height map"):
        contact.step(contact.apart, load_newton=[0.95 * load, 0, load])
