import numpy as np
import pytest

from resonator_daemon.estimate.forces.random_walk import RandomWalks


def test_only_walks_that_were_read_change():
    walks = RandomWalks(2, start_std=2.0)
    walks.measure(np.array([1.0, np.nan]), np.array([4.0, np.nan]), np.array([True, False]))
    assert walks.mean == pytest.approx([0.5, 0.0])
    assert walks.variance == pytest.approx([2.0, 4.0])


def test_estimates_are_those_of_the_joint_gaussian():
    # The whole history at once: x_k = x_{k-1} + w, z_k = x_k + v, conditioned by linear algebra.
    rng = np.random.default_rng(3)
    readings, step, noise, start = rng.normal(size=6), 0.3, 0.8, 2.0
    walks = RandomWalks(1, start_std=start)
    for reading in readings:
        walks.advance(step)
        walks.measure(np.array([reading]), noise, np.array([True]))
    times = np.arange(1, 7)
    covariance = start**2 + step * np.minimum.outer(times, times)
    gain = np.linalg.solve(covariance + noise * np.eye(6), covariance[:, -1])
    assert walks.mean[0] == pytest.approx(gain @ readings)
    assert walks.variance[0] == pytest.approx(covariance[-1, -1] - gain @ covariance[:, -1])
