"""Noise of the sites' oscillators, gate by gate: white, flicker and random-walk frequency modulation."""

import math
from typing import Final, NamedTuple

import numpy as np

from simulators.arrays import Floats

_LOWEST_POLE_HZ: Final = 1e-5
_POLES_PER_DECADE: Final = 2
# Sampled once a gate, a pole folds back what it has beyond the Nyquist frequency. With the highest pole at 0.42 of that
# frequency this makes up for the poles left out above: the Allan deviation is within 2.5 % from one gate on.
_HIGHEST_POLE_PER_GATE_RATE: Final = 0.21
# Mean of a Wiener process over a gate: its value before, and this much of the gate's step. The means then have the
# variance and the covariances that averaging gives, 2/3 and 1/6 of the step's variance for their differences.
_STEP_SHARE: Final = 0.5 + math.sqrt(1.0 / 12.0)


class GateNoise(NamedTuple):
    """Noise of n gates, each (n, oscillators). Phase time is the integral of the relative frequency shift."""

    relative_shift: Floats  # mean over the gate
    phase_mean_s: Floats  # phase time less the line between its values at the gate's two ends, averaged
    regression_excess: Floats  # slope of a regression of the phase time over the gate, less relative_shift


class OscillatorNoise:
    """Noise of independent oscillators, continuous from call to call.

    White FM with h0 = 2 s^2 has the variance h0 / (2 dt) in the mean over a gate; s is the Allan deviation at 1 s.
    Flicker FM with h-1 = s^2 / (2 ln 2) is a sum of Ornstein-Uhlenbeck processes, two per decade of corner frequency
    down to 1e-5 Hz, each of variance h-1 d(ln f), stationary from the start; level to 2.5 % from a gate to 3000 s.
    Random-walk FM with h-2 = 3 s^2 / (2 pi^2) walks by sqrt(2 pi^2 h-2 dt) a gate, from 0 (IEEE 1139; NIST SP 1065).

    White FM is the one that moves within a gate as well: `phase_mean_s` and `regression_excess` are its effects on a
    counter that measures more than the gate's two ends.

    Parameters
    ----------
    white_fm, random_walk_fm
        Allan deviations at 1 s.
    flicker_fm
        Allan deviation, at any time.
    """

    def __init__(
        self, oscillators: int, white_fm: float, flicker_fm: float, random_walk_fm: float, random: np.random.Generator
    ) -> None:
        self._white_fm = white_fm
        self._flicker_std = flicker_fm * math.sqrt(math.log(10.0) / _POLES_PER_DECADE / (2.0 * math.log(2.0)))
        self._random_walk_fm = random_walk_fm
        self._random = random
        self._dt_s = math.nan
        self._decay = np.empty((0, 1))
        self._kick = np.empty((0, 1))
        self._poles = np.empty((0, oscillators))
        self._walk = np.zeros(oscillators)

    def advance(self, dt_s: float, gates: int) -> GateNoise:
        """Go on by some gates of one length; a new length restarts the flicker."""
        if dt_s != self._dt_s:
            self._start_flicker(dt_s)
        poles, oscillators = self._poles.shape
        # One draw for each gate and all that is random in it, so that no splitting into calls changes a run.
        normal = self._random.standard_normal((gates, poles + 4, oscillators))

        flicker = normal[:, :poles]
        flicker *= self._kick
        before, decayed, decay = self._poles, np.empty_like(self._poles), self._decay
        for now in flicker:
            np.multiply(decay, before, out=decayed)
            np.add(now, decayed, out=now)
            before = now
        self._poles = before.copy()

        step = self._random_walk_fm * math.sqrt(3.0 * dt_s) * normal[:, poles]
        walk = self._walk + np.cumsum(step, axis=0)
        self._walk = walk[-1]

        white = self._white_fm / math.sqrt(dt_s) * normal[:, poles + 1 :]
        # Within a gate the phase is a Brownian bridge: its mean has 1/12 of the end's variance, its first moment 1/720.
        return GateNoise(
            relative_shift=white[:, 0] + flicker.sum(axis=1) + walk - (1.0 - _STEP_SHARE) * step,
            phase_mean_s=white[:, 1] * (dt_s * math.sqrt(1.0 / 12.0)),
            regression_excess=white[:, 2] * math.sqrt(144.0 / 720.0),
        )

    def _start_flicker(self, dt_s: float) -> None:
        highest_hz = _HIGHEST_POLE_PER_GATE_RATE / dt_s
        poles = math.ceil(_POLES_PER_DECADE * math.log10(highest_hz / _LOWEST_POLE_HZ)) + 1
        pole_hz = highest_hz * 10.0 ** (-np.arange(poles)[:, np.newaxis] / _POLES_PER_DECADE)
        turn = 2.0 * np.pi * pole_hz * dt_s
        self._dt_s = dt_s
        self._poles = self._flicker_std * self._random.standard_normal((poles, self._walk.size))
        # Repeated for each oscillator: what is contiguous is multiplied at once.
        self._decay = np.exp(-turn).repeat(self._walk.size, axis=1)
        self._kick = (self._flicker_std * np.sqrt(-np.expm1(-2.0 * turn))).repeat(self._walk.size, axis=1)
