"""Sensors under a skin: sets against closed forms, sums over plain grids and what Karason, Srinivasan and Annaswamy
publish; what arrays resolve against regression and dense scans; `resonatord plan sensors`.
"""

import json
import math

import numpy as np
import pytest

from resonator_daemon.base.arrays import Floats
from resonator_daemon.commands import main
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.extensions.planning.sensor_array import COMPONENTS, LOADS, SensorArray, SensorSet

E = 2.0e5
DEPTH_M = 1.3e-3
POISSON = [-0.7, 0.0, 0.3, 0.49, 0.5]
STRAINS = ("xx", "yy", "zz", "xy", "xz", "yz")
BEST = ("p_n", "xz", "yz")
# Of section 3.1.
CANDIDATES = {
    "a": ("xy", "xx", "yy"),
    "b": ("xx", "yy", "zz"),
    "c": ("zz", "xz", "yz"),
    "d": ("xy", "xz", "yz"),
    "e": ("p_n", "zz", "xy"),
    "f": ("p_n", "xx", "yy"),
    "g": ("p_n", "xz", "yz"),
}


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


def test_singular_values_of_the_best_set():
    """Across omega a factor of one; along it and z the block [[j, -1], [-(1 - t), j t]], of determinant one."""
    sensors = sensor_set(*BEST)
    for t in (1e-9, 1.0, 3.0, 40.0):  # at 40, signals of 1e-18
        omega = t / DEPTH_M * np.exp(1j * np.radians([0.0, 17.0, 90.0]))
        trace = 2.0 + t**2 + (1.0 - t) ** 2
        expected = (trace + math.sqrt(trace**2 - 4.0)) / 2.0  # ratio of singular values whose product is one
        values = sensors.singular_values(omega.real, omega.imag)
        np.testing.assert_allclose(values[:, 0] / values[:, 2], expected, rtol=1e-8)
    assert sensors.best_rank == 3
    assert sensor_set(*STRAINS).best_rank == 2


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
            values = sensors.singular_values(t / DEPTH_M * np.cos(direction), t / DEPTH_M * np.sin(direction))
            assert values[sensors.best_rank - 1] < 1e-12


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


def sensor_array(
    *components: str, nu: float = 0.5, depth_m: float = 1e-3, pitch_m: float = 0.4e-3, snr_db: float = 30.0
) -> SensorArray:
    return SensorArray(SensorSet(HalfSpace(2e5, nu), components or BEST, depth_m), pitch_m, snr_db)


def test_without_folding_the_error_is_that_of_the_inverse_matrix():
    array = sensor_array("p_n", "xz", "yz", "zz", nu=0.3, pitch_m=0.05e-3, snr_db=20.0)
    wx, wy = np.random.default_rng(2).uniform(-4e3, 4e3, (2, 50))
    matrix = array.sensors.matrix(wx, wy)
    error = array.noise_density * np.linalg.inv(matrix.conj().swapaxes(1, 2) @ matrix)
    np.testing.assert_allclose(array.load_to_error("normal", wx, wy), 1.0 / error[:, 2, 2].real, rtol=1e-6)
    worst = np.linalg.eigvalsh(error[:, :2, :2])[:, -1]
    np.testing.assert_allclose(array.load_to_error("shear", wx, wy), 1.0 / worst, rtol=1e-6)
    alone = (np.abs(matrix[..., 2]) ** 2).sum(axis=1) / array.noise_density
    np.testing.assert_allclose(array.load_to_error("normal_alone", wx, wy), alone, rtol=1e-6)


@pytest.mark.parametrize(("depths", "wx", "wy"), [(1.0, 0.1, 0.3), (4.0, 0.0, 0.2), (3.5, 0.4, 0.4)])
def test_what_a_coarse_pitch_folds_is_noise(depths: float, wx: float, wy: float):
    """p_n of a load without shear passes exp(-omega depth): its power, summed over all frequencies that look alike."""
    array = sensor_array("p_n", pitch_m=depths * 1e-3)
    sampling = 2.0 * np.pi / depths
    steps = np.arange(-30, 31) * sampling
    power = np.exp(-2.0 * np.hypot(wx + steps, wy + steps[:, None]))
    here = math.exp(-2.0 * math.hypot(wx, wy))
    expected = here / (array.noise_density + power.sum() - here)
    assert array.load_to_error("normal_alone", 1e3 * wx, 1e3 * wy) == pytest.approx(expected, rel=1e-4)


def test_nothing_is_known_beyond_nyquist():
    array, nyquist = sensor_array(), np.pi / 0.4e-3
    inside, beyond = 0.99 * nyquist, 1.01 * nyquist
    found = array.load_to_error("normal_alone", [inside, beyond, 0.0, -beyond], [0.0, 0.0, beyond, 0.0])
    assert found[0] > 0.5
    np.testing.assert_array_equal(found[1:], 0.0)


def test_the_sets_of_the_paper_under_an_incompressible_skin():
    for name, components in CANDIDATES.items():
        array = sensor_array(*components)
        resolved = {load: not math.isnan(array.features(load).finest_m) for load in LOADS}
        assert resolved["normal"] == (name in "efg")
        assert resolved["shear"] == (name == "g")
        assert resolved["normal_alone"]
    assert not math.isnan(sensor_array(*CANDIDATES["f"]).band("shear", math.radians(45.0))[0])
    assert math.isnan(sensor_array(*CANDIDATES["f"]).band("shear", 0.0)[0])


def test_bands_agree_with_a_dense_scan():
    for array, load in (
        (sensor_array(), "shear"),
        (sensor_array("xz", "yz"), "normal_alone"),
        (sensor_array("xz", "yz", pitch_m=2e-3, snr_db=10.0), "normal_alone"),
    ):
        low, high = array.band(load, math.radians(30.0))
        omega = np.geomspace(0.1, np.pi / array.pitch_m / math.cos(math.radians(30.0)), 8000)
        good = array.load_to_error(load, omega * math.cos(math.pi / 6), omega * 0.5) >= 1.0
        assert high == pytest.approx(omega[good].max(), rel=3e-3)
        assert low == pytest.approx(0.0 if good[0] else omega[good].min(), rel=3e-3)


def test_even_pressure_is_lost_where_it_makes_no_strain():
    """The strain zz of an incompressible skin is t exp(-t) of a pressure, t = omega depth: too weak below a wave."""
    array = sensor_array("zz")
    coarsest_m = array.features("normal_alone").coarsest_m
    t = np.pi / coarsest_m * 1e-3
    assert t * math.exp(-t) == pytest.approx(math.sqrt(array.noise_density), rel=1e-3)
    assert math.isinf(sensor_array("zz", nu=0.3).features("normal_alone").coarsest_m)


def test_json_is_one_object_in_si_units_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("--depth-mm", "2", "--pitch-mm", "1", "--poisson-ratio", "0.3")
    for options in (("--set", "xx,yy,zz"), (), ("--set", "xx", "--snr-db", "-40")):
        assert main(["plan", "sensors", "--json", *asked, *options]) == 0
        printed, reported = capsys.readouterr()
        assert (reported, "NaN" in printed) == ("", False)
        if not options:
            found = json.loads(printed)
    assert found["components"] == ["p_n", "xz", "yz"]
    assert (found["depth_m"], found["pitch_m"], found["poisson_ratio"]) == (0.002, 0.001, 0.3)
    assert found["youngs_modulus_pascal"] == 2e5
    assert (found["rank"], found["loss"]) == (3, "none")
    assert found["signals"][0]["bandwidth_rad_per_m"] == pytest.approx(0.5e3 / math.sqrt(2.0))
    assert found["signals"][1]["strongest_per_pascal"] == pytest.approx(1.3 / 2e5)  # shear over 2 mu
    assert found["signals"][3]["components"] == found["components"]
    assert found["resolved"]["normal"]["even_loads"] is True


def test_tables_show_what_is_resolved_and_why_not_more(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "sensors"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line.split() for line in lines]
    assert ["xz", "0.866", "0.236", "7500", "-"] in rows
    assert ["0.739", "0.739", "even"] in [row[-3:] for row in rows]
    assert main(["plan", "sensors", "--set", "xx,yy,zz"]) == 0
    printed = capsys.readouterr().out
    assert "Rank 2 of 3" in printed
    assert "add p_n" in printed.replace("\n", "")
