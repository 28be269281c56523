"""Step between codes by cause, the tones that follow, and the force noise of a counter."""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.forces.code_fit import RUNNER_UP_GAP
from resonator_daemon.estimate.tones.frequency_estimators import oscillator_std

NOISE_FACTOR: Final = math.sqrt(RUNNER_UP_GAP)  # standard deviations a site, so that odds are 1000 : 1


@dataclass(frozen=True)
class Limits:
    """Tolerances that a plate must accept; all but the first three relative to f0.

    `ageing` is the largest difference between two sites, `tolerance` how far a tone may lie from its code, `pulling`
    how far a corner may pull it, `common_shift` how far all tones may be off together, unnoticed.
    """

    force_max_newton: float
    temperature_span_kelvin: float
    tempco_difference_per_kelvin: float
    ageing: float
    noise_std: float
    pulling: float
    tolerance: float
    common_shift: float


class GuardBand(NamedTuple):
    """Contributions to the least step between the tones of neighbouring codes, relative."""

    force: float
    temperature: float
    ageing: float
    noise: float
    pulling: float
    placement: float
    common: float

    @property
    def step(self) -> float:
        return sum(self)


def guard_band(sensitivity: Floats, limits: Limits) -> GuardBand:
    """Return what keeps the bands of neighbouring codes apart, by cause; K in 1/N, (m, channels).

    Where both signs of K occur on one channel, bands grow towards each other: both count.
    """
    rising, falling = (np.maximum(sign * sensitivity, 0.0).max(axis=0) for sign in (1.0, -1.0))
    return GuardBand(
        force=limits.force_max_newton * float((rising + falling).max()),
        temperature=limits.tempco_difference_per_kelvin * limits.temperature_span_kelvin,
        ageing=limits.ageing,
        noise=2.0 * NOISE_FACTOR * limits.noise_std,
        pulling=2.0 * limits.pulling,
        placement=2.0 * limits.tolerance,
        common=2.0 * limits.common_shift,
    )


def ladder_hz(f0_hz: float, step: float, codes: NDArray[np.int64]) -> Floats:
    """Tones of codes 1, 2, ... below `f0_hz`, which no site has."""
    return np.asarray(f0_hz * (1.0 - step * codes), dtype=np.float64)


class ForceNoise(NamedTuple):
    """Standard deviations of one force in newtons: by the stamps, by the oscillator, and by both."""

    counter_newton: float
    oscillator_newton: float
    total_newton: float


def stamp_noise(tick_s: float, jitter_s: float, stamps_per_s: float, window_s: float) -> float:
    """Relative standard deviation of a regression over the window: sqrt(12 s^2 / (N T^2)), s of tick and jitter."""
    stamp_s = math.hypot(tick_s / math.sqrt(12.0), jitter_s)
    return stamp_s * math.sqrt(12.0 / (stamps_per_s * window_s)) / window_s


def force_noise(sensitivity: float, counter_std: float, window_s: float, channels: int) -> ForceNoise:
    """Return the noise of a force on `channels` of equal K: counters are independent, the oscillator is shared."""
    counter = counter_std / math.sqrt(channels) / abs(sensitivity)
    oscillator = oscillator_std(window_s) / abs(sensitivity)
    return ForceNoise(counter, oscillator, math.hypot(counter, oscillator))
