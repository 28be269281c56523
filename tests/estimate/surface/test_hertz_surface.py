"""Closed forms on the surface against sums of point loads (Boussinesq, Cerruti)."""

import numpy as np
import pytest

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.fitting.parametric_decoder import hertz_displacement, hertz_traction

RADIUS_M = 1.7e-3


def by_point_loads(nu: float, shear_modulus_pascal: float, place_m: Floats) -> Floats:
    """(force, displacement) in m/N; polar around the place, where the singularity of a point load cancels."""
    nodes, weights = np.polynomial.legendre.leggauss(400)
    angle = (np.arange(720) + 0.5) * np.pi / 360.0
    longest_m = float(np.hypot(*place_m)) + RADIUS_M
    distance = longest_m * (nodes + 1.0) / 2.0
    x, y = np.cos(angle)[:, None], np.sin(angle)[:, None]  # from the load to the place
    load_m = np.hypot(place_m[0] - distance * x, place_m[1] - distance * y)
    share = hertz_traction(load_m, RADIUS_M) * weights * longest_m / 2.0 * (np.pi / 360.0)
    one = np.ones_like(share)
    kernel = np.array(
        [
            [one * (1.0 - nu) + nu * x**2, nu * x * y * one, (0.5 - nu) * x * one],
            [nu * x * y * one, one * (1.0 - nu) + nu * y**2, (0.5 - nu) * y * one],
            [-(0.5 - nu) * x * one, -(0.5 - nu) * y * one, (1.0 - nu) * one],
        ]
    )
    return np.asarray((kernel * share).sum(axis=(2, 3)) / (2.0 * np.pi * shear_modulus_pascal), np.float64)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.6e-3, -0.9e-3), (-1.69e-3, 0.1e-3), (2.5e-3, 1.5e-3), (0.0, -6e-3)])
def test_displacement(nu: float, place: tuple[float, float]) -> None:
    skin = HalfSpace(2e5, nu)
    offset = np.array([place])
    expected = by_point_loads(nu, skin.shear_modulus_pascal, offset[0])
    found = hertz_displacement(skin, offset, RADIUS_M)[..., 0]
    np.testing.assert_allclose(found, expected, atol=5e-4 * expected[2, 2])


def test_traction_adds_up_to_a_newton() -> None:
    axis = (np.arange(400) - 199.5) * 1e-5
    x, y = np.meshgrid(axis, axis)
    assert hertz_traction(np.hypot(x, y), RADIUS_M).sum() * 1e-10 == pytest.approx(1.0, rel=1e-4)
    assert hertz_traction(np.array([0.0]), RADIUS_M)[0] == pytest.approx(1.5 / (np.pi * RADIUS_M**2))
