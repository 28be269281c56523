"""Patches of maps whose tractions are known pixel by pixel."""

import numpy as np
import pytest
from contact_scenes import PITCH_M, SITES_M

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.patches import Patch, PatchFinder
from simulators.contact import pixel_tractions

FINDER = PatchFinder(SITES_M, PITCH_M**2, 1e-3)
STD = np.full((3, len(SITES_M)), 100.0)


def pressed(force: tuple[float, float, float], centre_m: tuple[float, float], radius_m: float) -> Floats:
    """Traction averaged over pixels, (3, 32, 32)."""
    at_1_newton = radius_m / np.cbrt(force[2])
    return np.asarray(pixel_tractions(force, centre_m, at_1_newton, 0.6, (32, 32), PITCH_M), np.float64)


def find(traction: Floats, std: Floats = STD) -> list[Patch]:
    return FINDER.find(traction, std.reshape(traction.shape))


def test_one_contact() -> None:
    centre, force = (7e-4, -1.1e-3), (0.2, -0.3, 1.0)
    (patch,) = find(pressed(force, centre, 2.5e-3))
    np.testing.assert_allclose(patch.force_newton, force, rtol=1e-6)
    np.testing.assert_allclose(patch.centroid_m, centre, atol=2e-6)
    # all of the load is sheared alike about the centre
    x, y = centre
    np.testing.assert_allclose(patch.moment_newton_m, [y, -x, x * -0.3 - y * 0.2], atol=3e-6)
    assert patch.area_m2 == pytest.approx(np.pi * 2.5e-3**2, rel=0.06)
    assert patch.radius_m == pytest.approx(2.5e-3, rel=0.03)
    assert not patch.at_border


def test_two_contacts_keep_their_own_load() -> None:
    traction = pressed((0.0, 0.2, 0.4), (-3e-3, 1e-3), 1.6e-3) + pressed((0.3, 0.0, 1.0), (2.6e-3, -1e-3), 2e-3)
    heavy, light = find(traction)
    np.testing.assert_allclose(heavy.force_newton, [0.3, 0.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(light.force_newton, [0.0, 0.2, 0.4], atol=1e-3)
    assert not set(heavy.places) & set(light.places)


def test_small_bumps_and_noise_are_no_contacts() -> None:
    traction = pressed((0.0, 0.0, 1.0), (0.0, 0.0), 2.5e-3)
    peak = traction[2].max()
    traction[2, 2, 2] = 0.9 * peak  # a single place
    traction[2, 28:31, 28:31] = 0.2 * peak  # above the threshold, but without a peak
    assert len(find(traction)) == 1
    noise = 100.0 * np.random.default_rng(0).standard_normal((3, 32, 32))
    assert find(noise) == []
    assert find(np.zeros((3, 32, 32))) == []
    assert find(-traction) == []
    assert find(np.full((3, 32, 32), np.nan)) == []


def test_border() -> None:
    assert find(pressed((0.0, 0.0, 1.0), (6.2e-3, 0.0), 2e-3))[0].at_border
    assert not find(pressed((0.0, 0.0, 1.0), (3.5e-3, 0.0), 2e-3))[0].at_border


def test_sums_scatter_as_they_say_under_errors_of_short_reach() -> None:
    rng = np.random.default_rng(1)
    x, y = SITES_M.T
    correlation = np.exp(-np.hypot(x[:, None] - x, y[:, None] - y) / 2e-4)
    root = np.linalg.cholesky(correlation)
    centre, force = np.array([3e-3, -2e-4]), np.array([0.1, -0.2, 1.0])
    traction = pressed((0.1, -0.2, 1.0), (3e-3, -2e-4), 2e-3).reshape(3, -1)
    std = np.array([[300.0], [600.0], [900.0]]) * np.ones(len(SITES_M))
    wrench = np.array([-2e-4, -3e-3, 3e-3 * -0.2 + 2e-4 * 0.1])
    scores = []
    for _ in range(150):
        (patch,) = find(traction + std * (rng.standard_normal((3, len(SITES_M))) @ root.T), std)
        errors = [patch.force_newton - force, patch.moment_newton_m - wrench, patch.centroid_m - centre]
        spreads = [patch.force_std_newton, patch.moment_std_newton_m, patch.centroid_std_m]
        scores.append(np.concatenate(errors) / np.concatenate(spreads))
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert ((rms > 0.8) & (rms < 1.25)).all()


def test_irregular_places_with_areas_of_their_own() -> None:
    rng = np.random.default_rng(2)
    places = SITES_M + rng.uniform(-1e-4, 1e-4, SITES_M.shape)
    areas = rng.uniform(0.5, 1.5, len(places)) * PITCH_M**2
    inside = np.hypot(*(places - [1e-3, 0.0]).T) < 2e-3
    (patch,) = PatchFinder(places, areas, 1e-3).find(1e4 * inside * np.array([[0.1], [0.0], [1.0]]), STD)
    assert patch.area_m2 == pytest.approx(areas[inside].sum())
    np.testing.assert_allclose(patch.force_newton, 1e4 * areas[inside].sum() * np.array([0.1, 0.0, 1.0]))
    np.testing.assert_array_equal(patch.places, np.flatnonzero(inside))
