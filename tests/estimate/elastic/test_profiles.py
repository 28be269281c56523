"""Profiles of objects against the equations of their surfaces and counts of pixels."""

import numpy as np
import pytest

from resonator_daemon.estimate.elastic.profiles import flat_punch, paraboloid, relief, sphere

SHAPE, PITCH_M = (5, 8), 1e-3  # centres at y = -2 .. 2 mm, x = -3.5 .. 3.5 mm


def test_paraboloid_by_hand():
    found = paraboloid(SHAPE, PITCH_M, 0.02, (0.5e-3, -1e-3))
    assert found.shape == SHAPE
    assert found[1, 4] == pytest.approx(0.0, abs=1e-18)
    assert found[1, 0] == pytest.approx(4e-3**2 / 0.04)
    assert found[4, 7] == pytest.approx((3e-3**2 + 3e-3**2) / 0.04)


def test_sphere_lies_at_its_radius_from_its_middle():
    radius = 2.6e-3
    found = sphere(SHAPE, PITCH_M, radius, (0.5e-3, 0.0))
    y, x = np.mgrid[-2:3, -4:4] * 1e-3
    inside = np.isfinite(found)
    np.testing.assert_array_equal(inside, np.hypot(x, y) <= radius)
    to_middle = np.hypot(np.hypot(x, y), radius - np.where(inside, found, 0.0))
    np.testing.assert_allclose(to_middle[inside], radius, rtol=1e-12)


def test_flat_punch_fills_its_circle():
    found = flat_punch((400, 300), 1e-3, 0.1, (0.02, -0.05))
    assert set(np.unique(found)) == {0.0, np.inf}
    assert np.count_nonzero(found == 0.0) * 1e-6 == pytest.approx(np.pi * 0.1**2, rel=2e-3)
    rows, columns = np.nonzero(found == 0.0)
    assert rows.mean() == pytest.approx(199.5 - 50.0, abs=0.1)
    assert columns.mean() == pytest.approx(149.5 + 20.0, abs=0.1)


def test_relief_turns_elevation_and_surrounds_it():
    found = relief((4, 8), [[1e-4, 3e-4, 2e-4], [0.0, 1e-4, 1e-4]])
    expected = np.full((4, 8), np.inf)
    expected[1:3, 2:5] = [[2e-4, 0.0, 1e-4], [3e-4, 2e-4, 2e-4]]
    np.testing.assert_allclose(found, expected, atol=1e-18)
