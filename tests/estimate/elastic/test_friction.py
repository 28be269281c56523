"""Frictional contact against closed forms of partial slip and its history, dense algebra, and balances."""

from itertools import pairwise

import numpy as np
import pytest
from dense_surface import dense_compliance
from paraboloid_contact import A_M, G_PASCAL, R_M, SIDE_M, body, hertz_load, paraboloid, squared_radius
from scipy.optimize import brentq
from scipy.special import ellipk

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.contact import FrictionalContact, FrictionState
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance
from simulators.contact import pixel_tractions


def punch(pixels: int, radius_pixels: float, mu: float, nu: float, tolerance: float = 1e-8) -> FrictionalContact:
    pitch_m = 1e-4
    compliance = SurfaceCompliance(body(nu), (pixels, pixels), pitch_m)
    flat = np.where(squared_radius(pixels, 1.0) <= radius_pixels**2, 0.0, np.inf)
    return FrictionalContact(compliance, flat, mu, tolerance)


def stick_ratio(state: FrictionState) -> float:
    return float(np.sqrt(state.sticks.sum() / (state.sticks | state.slips).sum()))


def friction_work_joule(contact: FrictionalContact, before: FrictionState, after: FrictionState) -> float:
    shear_pascal = (before.traction_pascal + after.traction_pascal)[:2] / 2
    return float(np.vdot(shear_pascal, after.slip_m - before.slip_m)) * contact.compliance.pitch_m**2


# Partial slip of Cattaneo and Mindlin, nu = 1/2


@pytest.mark.parametrize(("pixels", "error_max", "ratio_max"), [(32, 0.06, 0.02), (64, 0.03, 0.01)])
def test_partial_slip_is_that_of_cattaneo_and_mindlin(pixels: int, error_max: float, ratio_max: float):
    mu, load = 0.5, hertz_load(0.5)
    along, across = np.array([[np.cos(np.pi / 6), np.sin(np.pi / 6)], [-np.sin(np.pi / 6), np.cos(np.pi / 6)]])
    contact = paraboloid(pixels, mu, 0.5)
    applied = np.array([*(0.875 * mu * load * along), load])
    state = contact.step(contact.apart, load_newton=applied)
    true = pixel_tractions(applied, (0, 0), A_M / np.cbrt(load), mu, (pixels, pixels), SIDE_M / pixels)
    shear, true_shear = (np.einsum("i,iyx->yx", along, f[:2]) for f in (state.traction_pascal, true))
    assert np.linalg.norm(shear - true_shear) <= error_max * np.linalg.norm(true_shear)
    assert abs(stick_ratio(state) - 0.5) <= ratio_max
    # The closed form neglects that the surface spreads across the load.
    transverse = np.abs(np.einsum("i,iyx->yx", across, state.traction_pascal[:2])).max() / true[2].max()
    assert 0.03 < transverse < 0.045
    np.testing.assert_allclose(state.load_newton, applied, rtol=1e-12)


def loop_shift_m(share: Floats, greatest: float, mu_load: float) -> Floats:
    """Shift while the load, in units of mu P, falls from `greatest`: Mindlin and Deresiewicz 1953."""
    scale_m = 3 * mu_load * 1.5 / (16 * G_PASCAL * A_M)
    return np.asarray(scale_m * (2 * (1 - (greatest - share) / 2) ** (2 / 3) - (1 - greatest) ** (2 / 3) - 1))


def test_reversed_load_leaves_the_loop_of_mindlin_and_deresiewicz():
    mu, load, greatest = 0.4, hertz_load(0.5), 0.8
    contact = paraboloid(32, mu, 0.5, tolerance=1e-6)
    states = [contact.step(contact.apart, load_newton=[0.0, 0.0, load])]
    for share in [*np.linspace(0.1, 0.8, 8), *np.linspace(0.7, -0.8, 16), *np.linspace(-0.7, 0.8, 16)]:
        states.append(contact.step(states[-1], load_newton=[share * mu * load, 0.0, load]))
    down, up = states[8:25], states[24:]
    shares = np.linspace(0.8, -0.8, 17)
    expected_m = loop_shift_m(shares, greatest, mu * load)
    np.testing.assert_allclose([s.shift_m[0] for s in down], expected_m, atol=0.02 * expected_m[0])
    np.testing.assert_allclose([s.shift_m[0] for s in up], -expected_m, atol=0.02 * expected_m[0])
    # No load, yet the shear that slip has locked in: full sliding backwards, twice what sticks on the way, forward.
    radius_m = np.sqrt(squared_radius(32, SIDE_M / 32))
    left = sum(
        weight * np.sqrt(np.maximum(A_M**2 * ratio ** (2 / 3) - radius_m**2, 0.0))
        for weight, ratio in [(-1.0, 1.0), (2.0, 1 - greatest / 2), (-1.0, 1 - greatest)]
    ) * (mu * 3 * load / (2 * np.pi * A_M**3))
    locked = down[8].traction_pascal[0]
    assert np.linalg.norm(locked - left) < 0.15 * np.linalg.norm(left)
    # What friction takes in a cycle is the area of the loop, twice the work on the way down.
    loop_joule = 2 * np.trapezoid(shares * mu * load, expected_m)
    taken_joule = sum(friction_work_joule(contact, *pair) for pair in pairwise(states[8:]))
    assert taken_joule == pytest.approx(loop_joule, rel=0.04)


# Coupling of pressure and shear, nu < 1/2


def spence_stick_ratio(mu: float, nu: float) -> float:
    """Spence 1975, for a coupling so weak that shear leaves the pressure as it is."""
    beta = (1 - 2 * nu) / (2 * (1 - nu))
    return float(brentq(lambda k: np.log((1 + k) / (1 - k)) / (2 * k) - mu / beta * ellipk(1 - k * k), 1e-9, 1 - 1e-12))


@pytest.mark.parametrize("ratio", [0.35, 0.5, 0.7, 1.0])
def test_pressed_punch_slips_outside_the_radius_of_spence(ratio: float):
    nu = 0.48
    mu = ratio * (1 - 2 * nu) / (2 * (1 - nu))
    contact = punch(64, 28.0, mu, nu, tolerance=1e-6)
    state = contact.step(contact.apart, load_newton=[0.0, 0.0, 1.0])
    assert stick_ratio(state) == pytest.approx(spence_stick_ratio(mu, nu), abs=0.015)


# Any shape, any history


def rough(rng: np.random.Generator, shape: tuple[int, int], pitch_m: float) -> Floats:
    y, x = ((np.arange(n) - (n - 1) / 2) * pitch_m for n in shape)
    heights = (x**2 + y[:, None] ** 2) / (2 * R_M) + 4e-6 * rng.standard_normal(shape)
    heights[1, 2] = np.inf
    return np.asarray(heights)


def relax(
    matrix: Floats, profile: Floats, mu: float, f: Floats, before: tuple[Floats, Floats], shift_m: Floats
) -> Floats:
    """Push against every violation of the law, pixel by pixel, until none is left."""
    shift_before, u_before = before
    rate = 0.8 / np.linalg.eigvalsh(matrix)[-1]
    for _ in range(60_000):
        u = (matrix @ f.ravel()).reshape(f.shape)
        pressure = np.where(np.isfinite(profile), np.maximum(f[2] + rate * (shift_m[2] - profile - u[2]), 0.0), 0.0)
        shear = f[:2] + rate * ((shift_m - shift_before)[:2, None, None] - u[:2] + u_before[:2])
        shear *= np.minimum(1.0, mu * pressure / np.maximum(np.hypot(*shear), 1e-30))
        moved, f = f, np.concatenate([shear, pressure[None]])
        if np.abs(f - moved).max() < 1e-13 * np.abs(f).max():
            break
    return f


def test_history_of_a_rough_object_is_that_of_a_dense_relaxation():
    shape, pitch_m, nu, mu = (9, 10), 4e-4, 0.2, 0.4
    profile = rough(np.random.default_rng(5), shape, pitch_m)
    contact = FrictionalContact(SurfaceCompliance(body(nu), shape, pitch_m), profile, mu, tolerance=1e-10)
    matrix = dense_compliance(shape, nu, G_PASCAL, pitch_m)
    state, f = contact.apart, np.zeros((3, *shape))
    shift_m, u = np.zeros(3), np.zeros_like(f)
    slips = 0
    for next_m in np.array([[0, 0, 2.0], [0.3, 0.1, 2.6], [0.6, 0.7, 2.2], [0.5, 0.4, 1.6], [0.5, 0.4, 2.4]]) * 1e-5:
        state = contact.step(state, shift_m=next_m)
        f = relax(matrix, profile, mu, f, (shift_m, u), next_m)
        shift_m, u = next_m, (matrix @ f.ravel()).reshape(f.shape)
        np.testing.assert_allclose(state.traction_pascal, f, atol=1e-7 * np.abs(f).max())
        np.testing.assert_allclose(state.displacement_m, u, atol=1e-7 * np.abs(u).max())
        slips += int(state.slips.sum())
    assert slips > 20


def test_lifted_off_it_forgets():
    contact = paraboloid(32, 0.4, 0.2)
    dragged = contact.step(contact.apart, shift_m=[0, 0, 2e-4])
    dragged = contact.step(dragged, shift_m=[5e-5, -2e-5, 2e-4])
    lifted = contact.step(dragged, shift_m=[5e-5, -2e-5, -1e-5])
    assert not lifted.traction_pascal.any()
    assert not lifted.slip_m.any()
    again = contact.step(lifted, shift_m=[5e-5, -2e-5, 2e-4])
    first = contact.step(contact.apart, shift_m=[0, 0, 2e-4])
    size = first.traction_pascal.max()
    np.testing.assert_allclose(again.traction_pascal, first.traction_pascal, atol=1e-6 * size)
    assert np.abs(dragged.traction_pascal - first.traction_pascal).max() > 0.1 * size


# What is refused, and what does not converge, with its status


def test_shear_that_friction_cannot_hold_is_refused():
    load, mu = hertz_load(0.5), 0.5
    contact = paraboloid(32, mu, 0.5)
    with pytest.raises(ValueError, match=r"shear load is .*must be below friction coefficient x normal load"):
        contact.step(contact.apart, load_newton=[0.6 * mu * load, 0.8 * mu * load, load])
    pressed = contact.step(contact.apart, load_newton=[0.0, 0.0, load])
    with pytest.raises(ValueError, match="prescribe shift_m instead"):
        contact.step(pressed, load_newton=[0, 1.01 * mu * load, np.nan], shift_m=[np.nan, np.nan, pressed.shift_m[2]])
    with pytest.raises(ValueError, match=r"shear load is 0.01 N, must be below .* = 0 N"):
        contact.step(pressed, load_newton=[0, 0.01, np.nan], shift_m=[np.nan, np.nan, -1e-4])


def test_contact_that_shear_spreads_to_the_border_is_refused():
    load = hertz_load(0.0, 0.4 * SIDE_M)
    contact = paraboloid(16, 1.0, 0.0)
    contact.step(contact.apart, load_newton=[0, 0, load])
    with pytest.raises(ValueError, match="contact touches the border of the height map"):
        contact.step(contact.apart, load_newton=[0.95 * load, 0, load])
