"""Noise by Box and Muller against the moments and the tails of the normal distribution."""

import numpy as np
from scipy.stats import kstest

from simulators.normal_noise import normal_noise


def test_deviates_are_normal_and_uncorrelated() -> None:
    noise = normal_noise(np.random.PCG64(1), (2, 200_000))
    assert noise.dtype == np.float32
    assert kstest(noise.ravel(), "norm").pvalue > 0.01
    assert np.abs(np.corrcoef(noise)[0, 1]) < 4.0 / np.sqrt(noise.shape[1])
    assert np.abs(np.corrcoef(noise**2)[0, 1]) < 4.0 / np.sqrt(noise.shape[1])
    assert 4.0 < np.abs(noise).max() < 6.9


def test_calls_continue_one_stream_of_bits() -> None:
    bits, again = np.random.PCG64(2), np.random.PCG64(2)
    first, second = normal_noise(bits, (4, 3)), normal_noise(bits, (4, 3))
    assert not (first == second).any()
    assert (normal_noise(again, (2, 6)).ravel() == first.ravel()).all()
