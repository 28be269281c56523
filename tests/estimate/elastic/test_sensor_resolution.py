"""What sensor arrays resolve, against white loads drawn, sampled with noise and estimated by plain regression."""

import math

import numpy as np
import pytest
from candidate_sets import CANDIDATES

from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.sensor_resolution import LOADS, Load, SensorArray
from resonator_daemon.estimate.elastic.sensor_sets import SensorSet

BEST = ("p_n", "xz", "yz")


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
        resolved = {load: not math.isnan(array.features_m(load)[0]) for load in LOADS}
        assert resolved["normal"] == (name in "efg")
        assert resolved["shear"] == (name == "g")
        assert resolved["normal_alone"]
    assert not math.isnan(sensor_array(*CANDIDATES["f"]).features_m("shear", math.radians(45.0))[0])
    assert math.isnan(sensor_array(*CANDIDATES["f"]).features_m("shear", 0.0)[0])


def test_bands_agree_with_a_dense_scan():
    for array, load in (
        (sensor_array(), "shear"),
        (sensor_array("xz", "yz"), "normal_alone"),
        (sensor_array("xz", "yz", pitch_m=2e-3, snr_db=10.0), "normal_alone"),
    ):
        finest_m, coarsest_m = array.features_m(load, math.radians(30.0))
        omega = np.geomspace(0.1, np.pi / array.pitch_m / math.cos(math.radians(30.0)), 8000)
        good = array.load_to_error(load, omega * math.cos(math.pi / 6), omega * 0.5) >= 1.0
        assert np.pi / finest_m == pytest.approx(omega[good].max(), rel=3e-3)
        if good[0]:
            assert math.isinf(coarsest_m)
        else:
            assert np.pi / coarsest_m == pytest.approx(omega[good].min(), rel=3e-3)


def test_even_pressure_is_lost_where_it_makes_no_strain():
    """The strain zz of an incompressible skin is t exp(-t) of a pressure, t = omega depth: too weak below a wave."""
    array = sensor_array("zz")
    coarsest_m = array.features_m("normal_alone")[1]
    t = np.pi / coarsest_m * 1e-3
    assert t * math.exp(-t) == pytest.approx(math.sqrt(array.noise_density), rel=1e-3)
    assert math.isinf(sensor_array("zz", nu=0.3).features_m("normal_alone")[1])


@pytest.mark.parametrize("load", LOADS)
def test_deepest_and_widest_are_borders(load: Load):
    array, feature_m = sensor_array(), 2e-3

    def resolved(**changes: float) -> bool:
        changed = sensor_array(**changes)
        return bool((changed.load_to_error(load, *np.pi / feature_m * directions) >= 1.0).all())

    directions = np.array([np.cos(np.radians(np.arange(0, 91, 7.5))), np.sin(np.radians(np.arange(0, 91, 7.5)))])
    deepest_m, widest_m = array.deepest_m(load, feature_m), array.widest_pitch_m(load, feature_m)
    assert resolved(depth_m=0.999 * deepest_m)
    assert not any(resolved(depth_m=deepest_m * factor) for factor in np.geomspace(1.001, 20.0, 40))
    assert resolved(pitch_m=0.999 * widest_m)
    if widest_m < feature_m:
        assert not any(resolved(pitch_m=widest_m * factor) for factor in np.geomspace(1.001, 4e-3 / widest_m, 20))
    finest_m = array.features_m(load)[0]
    assert array.deepest_m(load, finest_m * 1.01) >= 1e-3  # the depth itself
    assert math.isnan(array.deepest_m(load, 0.39e-3))
