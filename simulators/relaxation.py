"""Quantities that follow their target with one time constant, streamed gate by gate."""

import math

import numpy as np
from scipy.signal import lfilter

from simulators.arrays import Floats


class Relaxation:
    """dx/dt = (target - x) / time, exactly for a target that holds through each gate.

    Parameters
    ----------
    time_s
        Time constant.
    start
        x (k,) at the start of the first gate.
    """

    def __init__(self, time_s: float, start: Floats) -> None:
        self._time_s = time_s
        self._now = start

    def advance(self, dt_s: float, target: Floats) -> Floats:
        """Return x (n, k) in the middle of each of n gates, for the targets (n, k) in them."""
        if not target.any() and not self._now.any():  # at rest
            return np.zeros_like(target)
        half = math.exp(-0.5 * dt_s / self._time_s)
        decay = half * half
        gain = -math.expm1(-dt_s / self._time_s)
        if len(target) == 1:  # the filter's own set-up costs more than all the rest of a gate
            starts = self._now[np.newaxis]
            self._now = gain * target[0] + decay * self._now
            single: Floats = target + half * (starts - target)
            return single
        ends, _ = lfilter([gain], [1.0, -decay], target, axis=0, zi=decay * self._now[np.newaxis])
        starts = np.concatenate([self._now[np.newaxis], ends[:-1]])
        self._now = ends[-1]
        middles: Floats = target + half * (starts - target)
        return middles
