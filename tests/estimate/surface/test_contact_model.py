"""Spectral signals of discs against closed forms in space and against summed point loads."""

import numpy as np
import pytest
from contact_scenes import DEPTH_M, NU, SITES_M, E, hertz, summed_points

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel


def filled(model: DiscModel, centre_m: Floats, radius_m: float, force: tuple[float, float, float]) -> Floats:
    """Signals of a disc and their slopes by x, y, radius and the three forces, (7, 3, n)."""
    rows = np.empty((8, 3 * len(SITES_M)), np.float32)
    whiten = model.slip.whiten(np.ones(3 * len(SITES_M)))
    scales = model.slip.fill(np.array([*centre_m, radius_m, *force, 0.0]), whiten, rows)
    slopes = rows[[3, 4, 1, 5, 6, 7]] * scales[:6, None]
    return np.vstack([rows[:1], slopes]).reshape(7, 3, -1).astype(np.float64)


@pytest.mark.parametrize(
    ("centre_mm", "radius_mm"),
    [((0.0, 0.0), 0.0), ((0.0, 0.0), 2.5), ((0.2, -0.2), 1.13), ((5.0, -9.0), 3.3), ((1.0, 2.0), 0.35), ((0, 1), 6.0)],
)
def test_hertz_as_in_space(discs: DiscModel, centre_mm: tuple[float, float], radius_mm: float) -> None:
    centre = 1e-3 * np.array(centre_mm)
    expected = hertz(SITES_M, centre, 1e-3 * radius_mm)
    found = filled(discs, centre, 1e-3 * radius_mm, (0.1, 0.2, 1.0))
    for force in range(3):
        assert np.linalg.norm(found[4 + force] - expected[force]) < 3e-4 * np.linalg.norm(expected[force])
    total = np.einsum("f,fsn->sn", [0.1, 0.2, 1.0], expected)
    assert np.linalg.norm(found[0] - total) < 3e-4 * np.linalg.norm(total)


def test_slopes_are_those_of_the_closed_form(discs: DiscModel) -> None:
    centre, radius, step, force = np.array([3e-4, -7e-4]), 1.7e-3, 1e-7, (0.1, 0.2, 1.0)
    along_x, along_y = step * np.eye(2)
    _, by_x, by_y, by_radius, *_ = filled(discs, centre, radius, force)
    for slope, ahead, behind in (
        (by_x, hertz(SITES_M, centre + along_x, radius), hertz(SITES_M, centre - along_x, radius)),
        (by_y, hertz(SITES_M, centre + along_y, radius), hertz(SITES_M, centre - along_y, radius)),
        (by_radius, hertz(SITES_M, centre, radius + step), hertz(SITES_M, centre, radius - step)),
    ):
        expected = np.einsum("f,fsn->sn", force, (ahead - behind) / (2.0 * step))
        assert np.linalg.norm(slope - expected) < 1e-2 * np.linalg.norm(expected)


def test_another_depth_and_compressible() -> None:
    model = DiscModel(HalfSpace(E, 0.3), SITES_M, 0.8e-3, 3e-3)
    expected = hertz(SITES_M, np.array([1e-3, 0.0]), 2e-3, 0.8e-3, 0.3)
    found = filled(model, np.array([1e-3, 0.0]), 2e-3, (0.0, 0.0, 1.0))[4:]
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize("power", [-0.5, 0.0])
def test_other_pressures_as_summed_point_loads(power: float) -> None:
    model = DiscModel(HalfSpace(E, NU), SITES_M, DEPTH_M, 3e-3, power)
    centre = np.array([2e-4, -5e-4])
    expected = summed_points(centre, 2e-3 * np.eye(2), power)
    found = filled(model, centre, 2e-3, (0.0, 0.0, 1.0))[4:]
    assert np.linalg.norm(found - expected) < 1e-4 * np.linalg.norm(expected)
