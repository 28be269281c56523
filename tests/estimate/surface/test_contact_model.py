"""Spectral signals of discs against closed forms in space and against summed point loads."""

import numpy as np
import pytest
from contact_scenes import DEPTH_M, NU, SITES_M, E, hertz

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel


def flat_by_points(centre_m: Floats, radius_m: float) -> Floats:
    """Point loads on rings at r = a sin(angle), where the flat punch's pressure is even in the angle."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    total = np.zeros((3, 3, len(SITES_M)))
    for angle, weight in zip((nodes + 1.0) * np.pi / 4.0, weights * np.pi / 4.0, strict=True):
        for turn in np.arange(40) * 2.0 * np.pi / 40.0:
            place = centre_m + radius_m * np.sin(angle) * np.array([np.cos(turn), np.sin(turn)])
            total += weight * np.sin(angle) / 40.0 * hertz(SITES_M, place, 0.0)
    return total


@pytest.mark.parametrize(
    ("centre_mm", "radius_mm"),
    [((0.0, 0.0), 0.0), ((0.0, 0.0), 2.5), ((0.2, -0.2), 1.13), ((5.0, -9.0), 3.3), ((1.0, 2.0), 0.35), ((0, 1), 6.0)],
)
def test_hertz_as_in_space(discs: DiscModel, centre_mm: tuple[float, float], radius_mm: float) -> None:
    centre = 1e-3 * np.array(centre_mm)
    expected = hertz(SITES_M, centre, 1e-3 * radius_mm)
    found = discs.signals(centre, 1e-3 * radius_mm).value
    for force in range(3):
        assert np.linalg.norm(found[force] - expected[force]) < 1e-4 * np.linalg.norm(expected[force])


def test_slopes_are_those_of_the_closed_form(discs: DiscModel) -> None:
    centre, radius, step = np.array([3e-4, -7e-4]), 1.7e-3, 1e-7
    along_x, along_y = step * np.eye(2)
    found = discs.signals(centre, radius)
    for slope, ahead, behind in (
        (found.by_x, hertz(SITES_M, centre + along_x, radius), hertz(SITES_M, centre - along_x, radius)),
        (found.by_y, hertz(SITES_M, centre + along_y, radius), hertz(SITES_M, centre - along_y, radius)),
        (found.by_radius, hertz(SITES_M, centre, radius + step), hertz(SITES_M, centre, radius - step)),
    ):
        expected = (ahead - behind) / (2.0 * step)
        for force in range(3):
            assert np.linalg.norm(slope[force] - expected[force]) < 1e-3 * np.linalg.norm(expected[force])


def test_another_depth_and_compressible() -> None:
    found = DiscModel(HalfSpace(E, 0.3), SITES_M, 0.8e-3, 3e-3).signals(np.array([1e-3, 0.0]), 2e-3)
    expected = hertz(SITES_M, np.array([1e-3, 0.0]), 2e-3, 0.8e-3, 0.3)
    assert np.abs(found.value - expected).max() < 1e-4 * np.abs(expected).max()


def test_flat_as_summed_point_loads() -> None:
    flat = DiscModel(HalfSpace(E, NU), SITES_M, DEPTH_M, 3e-3, "flat")
    centre = np.array([2e-4, -5e-4])
    expected = flat_by_points(centre, 2e-3)
    assert np.linalg.norm(flat.signals(centre, 2e-3).value - expected) < 1e-4 * np.linalg.norm(expected)
