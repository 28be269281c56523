"""The half-space's transfer matrices against elasticity itself; at omega = 0; their conventions and shapes."""

import random

import numpy as np
import pytest
from boundary_value_problem import BoundaryValueProblem, mp

from resonator_daemon.estimate.elastic.half_space import HalfSpace, Input, Output
from resonator_daemon.estimate.elastic.transfer_matrices import MATRICES

POISSON = [-0.7, 0.0, 0.3, 0.49, 0.5]
E = 2.0e5


@pytest.mark.parametrize("source", ["traction", "displacement"])
def test_matrices_are_the_solution_of_the_boundary_value_problem(source: Input):
    """Waves in all four quadrants; the last two bodies are incompressible."""
    rng = random.Random(5)
    for number in range(8):
        nu = 0.5 if number > 5 else rng.uniform(-0.9, 0.5)
        x, y = (rng.choice((-1, 1)) * rng.uniform(0.3, 2.0) for _ in "xy")
        z, mu = rng.uniform(0.2, 1.5), rng.uniform(0.5, 2.0)
        problem = BoundaryValueProblem(mp.mpf(x), mp.mpf(y), mp.mpf(nu), mp.mpf(mu))
        solution = problem.matrices(source, mp.mpf(z))
        assert problem.residual < mp.mpf("1e-40")
        for output in (output for output, of_source in MATRICES if of_source == source):
            expected, depth = solution[output].astype(np.complex128), 0.0 if output == "traction" else z
            found = HalfSpace(2 * mu * (1 + nu), nu).transfer_matrix(output, source, x, y, depth)
            np.testing.assert_allclose(found, expected, atol=1e-14 * np.abs(expected).max(), rtol=0)


# --- omega = 0


@pytest.mark.parametrize("output", ["strain", "stress", "p_n", "sensor"])
@pytest.mark.parametrize("nu", POISSON)
def test_isolated_value_is_the_mean_over_directions(nu: float, output: Output):
    body = HalfSpace(E, nu)
    angle = np.arange(64) * (2 * np.pi / 64)
    near_zero = body.transfer_matrix(output, "traction", 1e-9 * np.cos(angle), 1e-9 * np.sin(angle), 1e-3).mean(axis=0)
    at_zero = body.transfer_matrix(output, "traction", 0.0, 0.0, 1e-3)
    np.testing.assert_allclose(at_zero, near_zero, atol=1e-11 * np.abs(at_zero).max())


@pytest.mark.parametrize("output", ["displacement", "strain", "stress", "p_n", "sensor", "traction"])
def test_displacement_input_has_its_true_limit(output: Output):
    body = HalfSpace(E, 0.3)
    near_zero = body.transfer_matrix(output, "displacement", 6e-10, 8e-10, 0.0)
    at_zero = body.transfer_matrix(output, "displacement", 0.0, 0.0, 0.0, zero="periodic")
    np.testing.assert_allclose(at_zero, near_zero, atol=1e-3 if output in ("stress", "p_n", "traction") else 1e-8)


@pytest.mark.parametrize("nu", POISSON)
def test_periodic_value_is_the_laterally_confined_body(nu: float):
    """Uniform traction: no strain across, Hooke's law, and a displacement that is the integral of the strain."""
    body = HalfSpace(E, nu)
    strain = body.transfer_matrix("strain", "traction", 0.0, 0.0, 1e-3, zero="periodic").real
    stress = body.transfer_matrix("stress", "traction", 0.0, 0.0, 1e-3, zero="periodic").real
    np.testing.assert_array_equal(stress[[4, 5, 2]], -np.eye(3))
    np.testing.assert_array_equal(strain[[0, 1, 3]], 0.0)
    compliance = (1 + nu) / E * stress
    compliance[:3] -= nu / E * stress[:3].sum(axis=0)
    np.testing.assert_allclose(strain, compliance, atol=1e-15 / E)
    p_n = body.transfer_matrix("p_n", "traction", 0.0, 0.0, 1e-3, zero="periodic").real
    np.testing.assert_allclose(p_n[0], stress[:3].mean(axis=0), atol=1e-15)
    sensor = body.transfer_matrix("sensor", "traction", 0.0, 0.0, 1e-3, zero="periodic").real
    np.testing.assert_allclose(sensor, [1.5 / E * p_n[0], strain[4], strain[5]], rtol=1e-14)
    depths = np.array([0.0, 1e-3])
    moved = body.transfer_matrix("displacement", "traction", 0.0, 0.0, depths, zero="periodic").real
    slope = (moved[1] - moved[0]) / 1e-3
    np.testing.assert_allclose(slope, np.diag([2 * strain[4, 0], 2 * strain[5, 1], strain[2, 2]]), rtol=1e-12)
    np.testing.assert_array_equal(moved[0], 0.0)


@pytest.mark.parametrize("nu", POISSON)
def test_mean_displacement_falls_with_depth_as_that_of_long_waves_in_all_directions(nu: float):
    body, depths, long = HalfSpace(E, nu), np.array([0.0, 1e-3]), 1e-3
    wx, wy = long * np.array([1.0, 0.0, -1.0, 0.0]), long * np.array([0.0, 1.0, 0.0, -1.0])
    waves = [body.transfer_matrix("displacement", "traction", x, y, depths) for x, y in zip(wx, wy, strict=True)]
    mean = np.mean(waves, axis=0).real
    moved = body.transfer_matrix("displacement", "traction", 0.0, 0.0, depths, period_m=0.1).real
    np.testing.assert_allclose(moved[1] - moved[0], mean[1] - mean[0], atol=1e-5 * 1e-3 / E)


def test_zero_frequency_can_be_refused():
    with pytest.raises(ValueError, match="omega is 0"):
        HalfSpace(E, 0.5).transfer_matrix("p_n", "traction", [1.0, 0.0], 0.0, 0.0, zero="raise")


# --- shapes


def test_frequencies_and_depths_broadcast():
    body = HalfSpace(E, 0.3)
    wx, wy, z = np.array([1.0, 2.0, 3.0]), np.array([[0.5], [0.0]]), np.array([0.0, 1e-3])[:, None, None]
    stacked = body.transfer_matrix("strain", "traction", wx, wy, z)
    assert stacked.shape == (2, 2, 3, 6, 3)
    assert stacked.dtype == np.complex128
    single = body.transfer_matrix("strain", "traction", 3.0, 0.5, 1e-3)
    assert single.shape == (6, 3)
    np.testing.assert_array_equal(stacked[1, 0, 2], single)
    zeros = body.transfer_matrix("p_n", "traction", [0.0, 1.0], 0.0, [[0.0], [1.0]])
    assert zeros.shape == (2, 2, 1, 3)
    assert np.isfinite(zeros).all()
