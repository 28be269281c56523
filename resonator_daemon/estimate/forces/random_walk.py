"""Random walks with occasional readings: a scalar Kalman filter for each."""

import math

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats


class RandomWalks:
    """Independent random walks; `mean` and `variance` have the shape (n,), infinite variance for one never measured."""

    def __init__(self, count: int, start_std: float = math.inf) -> None:
        self._start_std = start_std
        self.mean: Floats = np.zeros(count)
        self.variance: Floats = np.full(count, start_std**2)

    def reset(self) -> None:
        self.mean[:] = 0.0
        self.variance[:] = self._start_std**2

    def advance(self, step_variance: Floats | float) -> None:
        """Predict: add `step_variance` to the variances."""
        self.variance += step_variance

    def measure(self, reading: Floats, reading_variance: Floats | float, where: NDArray[np.bool_]) -> None:
        """Update with readings (n,) of the walks in `where`."""
        total = self.variance + reading_variance
        known = np.isfinite(total) & (total > 0)
        gain = np.where(known, self.variance / np.where(known, total, 1.0), 1.0)
        after = np.where(known, gain * reading_variance, reading_variance)
        self.mean = np.where(where, self.mean + gain * (reading - self.mean), self.mean)
        self.variance = np.where(where, after, self.variance)
