"""Quantities that follow their target with one time constant, streamed gate by gate."""

import math

import numpy as np

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
        starts = np.empty_like(target)
        for gate, gained in enumerate(gain * target):  # scipy.signal takes half a second to import
            starts[gate] = self._now
            self._now = gained + decay * self._now
        middles: Floats = target + half * (starts - target)
        return middles
