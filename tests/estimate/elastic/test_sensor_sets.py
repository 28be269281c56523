"""Sensor sets against closed forms, sums over plain grids, and what Karason, Srinivasan and Annaswamy publish."""

import math

import numpy as np
import pytest
from candidate_sets import CANDIDATES

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.sensor_sets import COMPONENTS, SensorSet

E = 2.0e5
DEPTH_M = 1.3e-3
POISSON = [-0.7, 0.0, 0.3, 0.49, 0.5]
STRAINS = ("xx", "yy", "zz", "xy", "xz", "yz")
BEST = ("p_n", "xz", "yz")


def sensor_set(*components: str, nu: float = 0.5, depth_m: float = DEPTH_M) -> SensorSet:
    return SensorSet(HalfSpace(E, nu), components, depth_m)


def random_frequencies(count: int = 100) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(11)
    t, angle = rng.uniform(0.02, 6.0, count), rng.uniform(-np.pi, np.pi, count)
    return t * np.cos(angle) / DEPTH_M, t * np.sin(angle) / DEPTH_M


def plane(edge: float = 14.0, count: int = 500) -> tuple[Floats, Floats, float]:
    """Frequencies over a quarter of the plane, at the middles of squares, and the area that each stands for."""
    step = edge / count / DEPTH_M
    omega = (np.arange(count) + 0.5) * step
    return omega, omega[:, None], 4.0 * step**2


@pytest.mark.parametrize("nu", POISSON)
def test_determinants_of_the_candidates(nu: float):
    wx, wy = random_frequencies()
    w = np.hypot(wx, wy)
    c, s = wx / w, wy / w
    shape = {
        "a": 0.0 * c, "b": 4.0 * (1.0 - 2.0 * nu) * c * s, "c": -(1.0 - 2.0 * nu) + 0.0 * c,
        "d": -(1.0 - 2.0 * nu) * c * s, "e": s**2 - c**2, "f": 2.0 * c * s, "g": -1.0 + 0.0 * c
    }  # fmt: skip
    for name, expected in shape.items():
        found = np.linalg.det(sensor_set(*CANDIDATES[name], nu=nu).matrix(wx, wy)) * np.exp(3.0 * w * DEPTH_M)
        np.testing.assert_allclose(found, expected, atol=1e-11, err_msg=name)


@pytest.mark.parametrize("nu", POISSON)
def test_signals_are_dimensionless_and_per_twice_the_shear_modulus(nu: float):
    body = HalfSpace(E, nu)
    wx, wy = random_frequencies()
    two_mu = E / (1.0 + nu)
    every = sensor_set(*COMPONENTS, nu=nu).matrix(wx, wy) / two_mu
    stress = body.transfer_matrix("stress", "traction", wx, wy, DEPTH_M)
    np.testing.assert_allclose(
        every[:, 1:7], body.transfer_matrix("strain", "traction", wx, wy, DEPTH_M), rtol=1e-13, atol=1e-25
    )
    np.testing.assert_allclose(every[:, 7:], stress / two_mu, rtol=1e-13)
    np.testing.assert_allclose(every[:, 0], stress[:, :3].sum(axis=1) / (2.0 * E), rtol=1e-9, atol=1e-14 / E)
    np.testing.assert_allclose(
        sensor_set(*BEST, nu=nu).matrix(wx, wy) / two_mu,
        body.transfer_matrix("sensor", "traction", wx, wy, DEPTH_M),
        rtol=1e-13,
    )


def test_condition_of_the_best_set():
    """Across omega a factor of one; along it and z the block [[j, -1], [-(1 - t), j t]], of determinant one."""
    sensors = sensor_set(*BEST)
    for t in (1e-9, 1.0, 3.0):
        omega = t / DEPTH_M * np.exp(1j * np.radians([0.0, 17.0, 90.0]))
        trace = 2.0 + t**2 + (1.0 - t) ** 2
        expected = (trace + math.sqrt(trace**2 - 4.0)) / 2.0  # ratio of singular values whose product is one
        np.testing.assert_allclose(sensors.condition(omega.real, omega.imag), expected, rtol=1e-8)
    assert sensors.condition(1.0 / DEPTH_M, 0.0) == pytest.approx((3.0 + math.sqrt(5.0)) / 2.0)


def test_rank_does_not_fade_with_the_signals():
    wx, wy = 40.0 / DEPTH_M * np.array([0.6, -0.8])  # signals of 1e-18
    assert sensor_set(*BEST).rank(wx, wy) == 3
    assert sensor_set(*STRAINS).rank(wx, wy) == 2
    assert sensor_set(*BEST).condition(wx, wy) == pytest.approx(2 * 40**2 - 2 * 40 + 3, rel=1e-3)


@pytest.mark.parametrize(
    ("components", "nu", "loss", "degrees"),
    [
        (CANDIDATES["a"], 0.5, "dependent", None), (CANDIDATES["a"], 0.3, "dependent", []),
        (CANDIDATES["b"], 0.5, "incompressible", None), (CANDIDATES["b"], 0.3, "none", [0.0, 90.0]),
        (CANDIDATES["c"], 0.5, "incompressible", None), (CANDIDATES["c"], 0.3, "none", []),
        (CANDIDATES["d"], 0.5, "incompressible", None), (CANDIDATES["d"], 0.3, "none", [0.0, 90.0]),
        (CANDIDATES["e"], 0.5, "none", [45.0, 135.0]), (CANDIDATES["f"], 0.5, "none", [0.0, 90.0]),
        (CANDIDATES["g"], 0.5, "none", []), (("sigma_zz", "sigma_xz", "sigma_yz"), 0.5, "none", None),
        (("p_n",), 0.5, "too_few", None), (("p_n", "zz"), 0.3, "too_few", None), (("xx",), 0.5, "too_few", [90.0]),
        (("xz", "sigma_xz"), 0.3, "dependent", None),
        # s^2 = 2 c^2: with sigma_zz known, sigma_xx and xy then tell the same
        (("xy", "sigma_xx", "sigma_zz"), 0.5, "none", [math.degrees(math.atan(math.sqrt(2.0))), 125.26438968]),
    ],
)  # fmt: skip
def test_why_a_set_is_deficient_and_in_which_directions(
    components: tuple[str, ...], nu: float, loss: str, degrees: list[float] | None
):
    sensors = sensor_set(*components, nu=nu)
    assert sensors.loss == loss
    if degrees is not None:
        np.testing.assert_allclose(np.degrees(sensors.blind_directions_rad), degrees, atol=1e-6)
    for direction in np.radians([x for x in degrees or () if x % 45.0 == 0.0]):
        for t in (0.2, 1.0, 4.0):
            assert sensors.rank(t / DEPTH_M * np.cos(direction), t / DEPTH_M * np.sin(direction)) < sensors.best_rank


def test_power_in_closed_form():
    wx, wy = random_frequencies()
    w = np.hypot(wx, wy)
    t, c2, s2 = w * DEPTH_M, (wx / w) ** 2, (wy / w) ** 2
    fading = np.exp(-2.0 * t)
    found = sensor_set("p_n", "xz", "yz", "zz").power(wx, wy)
    expected = [2.0 + 0.0 * t, 1.0 - 2.0 * c2 * (t - t**2), 1.0 - 2.0 * s2 * (t - t**2), (1.0 - t) ** 2 + t**2]
    np.testing.assert_allclose(found, fading[:, None] * np.transpose(expected), rtol=1e-11)


@pytest.mark.parametrize("components", [("zz",), ("xx",), ("xy",), ("sigma_yy", "xz"), CANDIDATES["e"]])
def test_bandwidth_and_integral_against_a_sum_over_the_plane(components: tuple[str, ...]):
    sensors = sensor_set(*components, nu=0.3)
    wx, wy, area = plane()
    power = sensors.power(wx, wy).sum(axis=-1)
    assert sensors.power_integral_per_m2 == pytest.approx(
        power.sum() * area, rel=1e-3
    )  # falls with the square of the step
    t, angle = np.geomspace(1e-6, 10.0, 700), np.radians(np.linspace(0.0, 90.0, 61))[:, None]
    highest = sensors.power(t / DEPTH_M * np.cos(angle), t / DEPTH_M * np.sin(angle)).sum(axis=-1).max()
    assert sensors.highest_power == pytest.approx(highest, rel=1e-4)
    disc = math.pi * sensors.bandwidth_rad_per_m**2 * sensors.highest_power
    assert disc == pytest.approx(power.sum() * area, rel=1e-3)  # falls with the square of the step


def test_symmetry_as_published():
    for symmetric in (("p_n",), ("zz",), BEST, CANDIDATES["c"], ("sigma_zz", "sigma_xz", "sigma_yz")):
        assert sensor_set(*symmetric, nu=0.3).asymmetry < 1e-12
    for name in ("b", "d", "e", "f"):
        assert sensor_set(*CANDIDATES[name], nu=0.3).asymmetry > 0.05
    for single in ("xx", "yy", "xy"):
        assert sensor_set(single, nu=0.3).asymmetry > 0.3
    assert sensor_set("xz").asymmetry == pytest.approx(1 / math.sqrt(18))  # by hand from its power, above


@pytest.mark.parametrize("short_of_half", [1e-6, 1e-8, 1e-10])
def test_a_nearly_incompressible_skin_has_no_blind_directions_of_rounding(short_of_half: float):
    assert SensorSet(HalfSpace(2e5, 0.5 - short_of_half), ("zz", "xz", "yz"), 1e-3).blind_directions_rad == ()
