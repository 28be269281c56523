"""Extension of an array beyond its border, so that the period of a Fourier transform does less harm."""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Floats = NDArray[np.float64]


def extended_length(count: int) -> int:
    """Even length of about 1.5 times `count` samples that transforms fast."""
    return 2 * fft.next_fast_len(-(-3 * count // 4), real=True)


def extension(count: int, length: int) -> Floats:
    """Matrix (length, count): the samples first, then the last and the first one repeated, tapered to 0 by a cosine.

    Each taper is a quarter of the samples long, or half of what is free where that is less; the rest is 0.
    """
    free = length - count
    taper = min(-(-count // 4), free // 2)
    matrix = np.zeros((length, count))
    matrix[:count] = np.eye(count)
    weights = 0.5 + 0.5 * np.cos(np.pi * np.arange(1, taper + 1) / (taper + 0.5))
    matrix[count : count + taper, -1] = weights
    matrix[length - taper :, 0] += weights[::-1]
    return matrix


def noise_power(matrix: Floats) -> Floats:
    """Power (length,) of white noise of unit variance after `extension`, in each bin of the unitary transform."""
    return np.asarray((np.abs(fft.fft(matrix, axis=0, norm="ortho")) ** 2).sum(axis=1), np.float64)
