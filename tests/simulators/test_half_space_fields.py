"""Hertz fields against Johnson's point loads summed over the disc."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from resonator_daemon.arrays import Floats
from simulators.half_space_fields import hertz_fields

E = 2e5

XX, YY, ZZ, XY, XZ, YZ = range(6)


def boussinesq(x: Floats, y: Floats, z: float, nu: float) -> Floats:
    """Stresses (6, ...) under a unit normal point load, as Johnson prints them in cylindrical coordinates."""
    r2 = x**2 + y**2
    rho = np.sqrt(r2 + z**2)
    radial = (1 - 2 * nu) * (1 - z / rho) / r2 - 3 * z * r2 / rho**5
    hoop = -(1 - 2 * nu) * ((1 - z / rho) / r2 - z / rho**3)
    cos2, sin2, sincos = x**2 / r2, y**2 / r2, x * y / r2
    stress: Floats = np.stack(
        [
            radial * cos2 + hoop * sin2,
            radial * sin2 + hoop * cos2,
            -3 * z**3 / rho**5,
            (radial - hoop) * sincos,
            -3 * x * z**2 / rho**5,
            -3 * y * z**2 / rho**5,
        ]
    )
    stress /= 2 * math.pi
    return stress


def cerruti(x: Floats, y: Floats, z: float, nu: float) -> Floats:
    """Stresses (6, ...) under a unit tangential point load along x, as Johnson prints them."""
    rho = np.sqrt(x**2 + y**2 + z**2)
    s = rho + z

    def round_the_load(first: Floats, linear: Floats, cubic: Floats) -> Floats:
        terms: Floats = first / rho**3 - linear / (rho * s**2)
        return (1 - 2 * nu) * (terms + cubic / (rho**3 * s**2) + 2 * cubic / (rho**2 * s**3))

    return np.stack(
        [
            -3 * x**3 / rho**5 + round_the_load(x, 3 * x, x**3),
            -3 * x * y**2 / rho**5 + round_the_load(x, x, x * y**2),
            -3 * x * z**2 / rho**5,
            -3 * x**2 * y / rho**5 + round_the_load(0 * x, y, x**2 * y),
            -3 * x**2 * z / rho**5,
            -3 * x * y * z / rho**5,
        ]
    ) / (2 * math.pi)


PointLoad = Callable[[Floats, Floats, float, float], Floats]


def over_disc(
    load: PointLoad,
    places: Floats,
    z: float,
    radius: float,
    nu: float,
    *,
    hertz: bool = True,
    rings: int = 150,
    spokes: int = 240,
) -> Floats:
    """Stresses (6, n) of a unit force spread over a disc; r = a sqrt(1 - u^2) takes the Hertz edge out of the rule."""
    u, weight = np.polynomial.legendre.leggauss(rings)
    u, weight = (1 + u) / 2, weight / 2
    r, angle = radius * np.sqrt(1 - u**2), 2 * math.pi * (np.arange(spokes) + 0.5) / spokes
    weight = weight * (3 * u**2 if hertz else 2 * u) / spokes
    stress = np.zeros((6, len(places)))
    for k, (x, y) in enumerate(places):
        stress[:, k] = load(x - np.outer(r, np.cos(angle)), y - np.outer(r, np.sin(angle)), z, nu).sum(axis=2) @ weight
    return stress


def as_signals(stress: Floats, nu: float) -> Floats:
    return np.stack([stress[[XX, YY, ZZ]].sum(axis=0) / 3, *(stress[[XZ, YZ]] * (1 + nu) / E)])


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])
@pytest.mark.parametrize(("z", "a"), [(5e-4, 4e-3), (1e-3, 2.5e-3), (2e-3, 1e-4)])
def test_fields_equal_the_summed_point_loads(z: float, a: float, nu: float) -> None:
    rng = np.random.default_rng(7)
    places = np.concatenate([rng.uniform(-1.5 * a, 1.5 * a, (5, 2)), [[a, 0], [0, -a], [3e-3, 12e-3]]])
    found = hertz_fields(places, z, [a], E, nu)[0]
    normal = over_disc(boussinesq, places, z, a, nu)
    along_x = over_disc(cerruti, places, z, a, nu)
    turned = over_disc(cerruti, places[:, ::-1] * [1, -1], z, a, nu)  # y becomes x, and x becomes -y
    along_y = turned[[YY, XX, ZZ, XY, YZ, XZ]] * np.array([1, 1, 1, -1, -1, 1])[:, np.newaxis]
    for force, stress in enumerate([along_x, along_y, normal]):
        expected = as_signals(stress, nu)
        error = np.abs(found[force] - expected).max(axis=1) / np.abs(expected).max(axis=1)
        assert error.max() < 1e-9
