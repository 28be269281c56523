"""Hertz fields against Johnson's point loads summed over the disc, closed forms and field equations."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from resonator_daemon.arrays import Floats
from simulators.half_space_fields import hertz_fields

E, NU = 2e5, 0.3
MODULUS_OF_SHEAR = E / (2 * (1 + NU))

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


def test_uniform_disc_validates_the_summed_point_loads() -> None:
    a, z = 2e-3, 1.3e-3
    stress = over_disc(boussinesq, np.zeros((1, 2)), z, a, NU, hertz=False, rings=60, spokes=16)[:, 0]
    p, rho = 1 / (math.pi * a**2), math.hypot(a, z)
    assert stress[ZZ] == pytest.approx(-p * (1 - (z / rho) ** 3), rel=1e-10)
    lateral = -p * ((1 + 2 * NU) / 2 - (1 + NU) * z / rho + (z / rho) ** 3 / 2)
    np.testing.assert_allclose(stress[[XX, YY]], lateral, rtol=1e-10)


@pytest.mark.parametrize("load", [boussinesq, cerruti])
def test_stresses_of_the_summed_point_loads_are_in_equilibrium(load: PointLoad) -> None:
    def stress(x: float, y: float, z: float) -> Floats:
        return over_disc(load, np.array([[x, y]]), z, 2.0, NU, rings=40, spokes=80)[:, 0]

    h = 1e-3
    d_x, d_y, d_z = (
        (stress(1.1 + h * i, 0.7 + h * j, 1.0 + h * k) - stress(1.1 - h * i, 0.7 - h * j, 1.0 - h * k)) / (2 * h)
        for i, j, k in np.eye(3)
    )
    divergence = d_x[[XX, XY, XZ]] + d_y[[XY, YY, YZ]] + d_z[[XZ, YZ, ZZ]]
    assert np.abs(divergence).max() < 1e-5 * max(np.abs(d).max() for d in (d_x, d_y, d_z))


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


def test_radius_zero_is_the_point_load() -> None:
    x, y = np.array([1e-3, -3e-4]), np.array([2e-3, 1e-4])
    found = hertz_fields(np.stack([x, y], axis=1), 1e-3, [0.0], E, NU)[0]
    np.testing.assert_allclose(found[2], as_signals(boussinesq(x, y, 1e-3, NU), NU), rtol=1e-12)
    np.testing.assert_allclose(found[0], as_signals(cerruti(x, y, 1e-3, NU), NU), rtol=1e-12)


@pytest.mark.parametrize("z_over_a", [0.02, 0.3, 1.0, 5.0])
def test_axis_of_a_hertz_pressure(z_over_a: float) -> None:
    a = 2e-3
    p0 = 3 / (2 * math.pi * a**2)
    over = 0.5 / (1 + z_over_a**2)
    lateral = -(1 + NU) * (1 - z_over_a * math.atan(1 / z_over_a)) + over
    p_n, eps_xz, eps_yz = hertz_fields([[0.0, 0.0]], z_over_a * a, [a], E, NU)[0, 2, :, 0]
    assert p_n == pytest.approx(p0 * (2 * lateral - 2 * over) / 3, rel=1e-10)
    assert eps_xz == 0
    assert eps_yz == 0


@pytest.mark.parametrize("z_over_a", [0.05, 0.7, 4.0])
def test_axis_of_a_hertz_shear_traction(z_over_a: float) -> None:
    a, ratio = 2e-3, z_over_a
    tau = 3 / (2 * math.pi * a**2) * (-1 + 1.5 * ratio * math.atan(1 / ratio) - ratio**2 / (2 * (1 + ratio**2)))
    p_n, eps_xz, eps_yz = hertz_fields([[0.0, 0.0]], ratio * a, [a], E, NU)[0, 0, :, 0]
    assert eps_xz == pytest.approx(tau / (2 * MODULUS_OF_SHEAR), rel=1e-9)
    assert p_n == 0
    assert eps_yz == 0


def test_every_plane_below_carries_the_force() -> None:
    u, weight = np.polynomial.legendre.leggauss(80)
    u, weight = (1 + u) / 2, weight / 2
    length, spokes = 3e-3, 8  # r = length u/(1 - u) reaches from the axis to infinity; the angles' sums are exact
    r, d_r = length * u / (1 - u), length / (1 - u) ** 2
    angle = 2 * math.pi * (np.arange(spokes) + 0.3) / spokes
    places = np.stack([np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle))], axis=-1).reshape(-1, 2)
    area = np.repeat(weight * d_r * r * 2 * math.pi / spokes, spokes)
    total = hertz_fields(places, 1e-3, [2.5e-3], E, NU)[0] @ area
    total[:, 1:] *= 2 * MODULUS_OF_SHEAR
    # The plane pushes back with the load; the mean of p_n is that of a field whose lateral stresses carry -(1/2 + nu).
    expected = np.array([[0, -1, 0], [0, 0, -1], [-2 * (1 + NU) / 3, 0, 0]])
    np.testing.assert_allclose(total, expected, atol=1e-9)


def test_beltrami_michell_equations() -> None:
    """p_n is harmonic, and laplace(sigma_iz) = -3/(1 + nu) d_i d_z p_n: equilibrium and compatibility in one."""
    h, at = 2e-5, np.array([1.2e-3, -0.7e-3, 1e-3])

    def signals(*steps: float) -> Floats:
        x, y, z = at + h * np.array(steps)
        return hertz_fields([[x, y]], z, [2.5e-3], E, NU)[0, :, :, 0]

    def second(i: int, j: int) -> Floats:
        one, other = np.eye(3)[i], np.eye(3)[j]
        if i == j:
            return (signals(*one) - 2 * signals(0, 0, 0) + signals(*-one)) / h**2
        corners = signals(*one + other) - signals(*one - other) - signals(*other - one) + signals(*-one - other)
        return corners / (4 * h**2)

    laplace = second(0, 0) + second(1, 1) + second(2, 2)
    size = np.abs(second(2, 2)).max(axis=0)
    assert np.abs(laplace[:, 0]).max() < 1e-3 * size[0]
    for axis in (0, 1):
        sigma = 2 * MODULUS_OF_SHEAR * laplace[:, 1 + axis]
        assert np.abs(sigma + 3 / (1 + NU) * second(axis, 2)[:, 0]).max() < 2e-3 * np.abs(sigma).max()


def test_fields_turn_with_the_load() -> None:
    angle = 0.7
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    places = np.random.default_rng(3).uniform(-4e-3, 4e-3, (6, 2))
    straight = hertz_fields(places, 1e-3, [2e-3], E, 0.5)[0]
    turned = hertz_fields(places @ turn.T, 1e-3, [2e-3], E, 0.5)[0]
    about_z = np.eye(3)
    about_z[:2, :2] = turn
    loaded = np.einsum("jk,jsn->ksn", about_z, turned)  # the load that was along axis k, turned
    np.testing.assert_allclose(loaded[:, 0], straight[:, 0], rtol=1e-9, atol=1e-9 * np.abs(straight[:, 0]).max())
    expected = np.einsum("st,ktn->ksn", turn, straight[:, 1:])
    np.testing.assert_allclose(loaded[:, 1:], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth_m": 0.0}, "depth_m is 0.0"),
        ({"poisson_ratio": 0.51}, r"poisson_ratio is 0\.51"),
        ({"poisson_ratio": -1.0}, "poisson_ratio is -1"),
        ({"youngs_modulus_pascal": 0.0}, "youngs_modulus_pascal is 0"),
        ({"radii_m": [-1e-3]}, "radii_m"),
        ({"radii_m": 1e-3}, "radii_m"),
        ({"offsets_m": [0.0, 1.0]}, r"shape \(2,\)"),
    ],
)
def test_impossible_arguments_are_refused(change: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {
        "offsets_m": [[0.0, 0.0]],
        "depth_m": 1e-3,
        "radii_m": [1e-3],
        "youngs_modulus_pascal": E,
        "poisson_ratio": NU,
    }
    with pytest.raises(ValueError, match=message):
        hertz_fields(**(arguments | change))  # type: ignore[arg-type]
