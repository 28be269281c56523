"""Ladder of codes: the step between them by cause, the noise of a counter, and which site gets which code."""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats, Integers
from resonator_daemon.estimate.forces.code_fit import RUNNER_UP_GAP
from resonator_daemon.estimate.tones.frequency_estimators import oscillator_std

NOISE_FACTOR: Final = math.sqrt(RUNNER_UP_GAP)  # standard deviations a site, so that odds are 1000 : 1

NEIGHBOUR_FACTOR: Final = 1.5  # times the usual distance to the nearest site: on a square grid, diagonals too
DECAY_FACTOR: Final = 0.25  # of that distance: in it the coupling of two trapped modes falls by e, about
NEIGHBOUR_STEPS: Final = 2  # at least, between the codes of neighbours
NEAR_COST: Final = 5.0  # of neighbours with adjacent codes; the strongest coupling one step apart costs 1
TRIES_A_SITE: Final = 100
STARTS: Final = 4


@dataclass(frozen=True)
class Tolerances:
    """Tolerances of a plate.

    Values without a unit are relative to f0; those with `sensitivity` in the name are relative to K.
    `ageing` is the largest difference between two sites, `placement` how far a tone may lie from its code, `pulling`
    how far a corner may pull it, `sensitivity_spread` how far K may lie from what is aimed at. `model_error` is the
    error of K from touch to touch; `counter_std` and `oscillator_std` are the noise of a reading.
    """

    force_max_newton: float
    temperature_span_kelvin: float
    tempco_std: float
    tempco_difference_per_kelvin: float
    ageing: float
    pulling: float
    placement: float
    sensitivity_spread: float
    model_error: float
    counter_std: float
    oscillator_std: float


class GuardBand(NamedTuple):
    """Contributions to the least step between the tones of neighbouring codes, relative."""

    force: float
    temperature: float
    ageing: float
    noise: float
    pulling: float
    placement: float

    @property
    def step(self) -> float:
        return sum(self)


def guard_band(sensitivity: Floats, tolerances: Tolerances) -> GuardBand:
    """Return what keeps the bands of neighbouring codes apart, by cause; K in 1/N, (m, channels).

    Where both signs of K occur on one channel, bands grow towards each other: both count.
    """
    largest = 1.0 + tolerances.sensitivity_spread
    rising, falling = (largest * np.maximum(sign * sensitivity, 0.0).max(axis=0) for sign in (1.0, -1.0))
    error = tolerances.model_error * tolerances.force_max_newton * float(np.maximum(rising, falling).max())
    noise_std = math.hypot(tolerances.counter_std, tolerances.oscillator_std, error)
    return GuardBand(
        force=tolerances.force_max_newton * float((rising + falling).max()),
        temperature=tolerances.tempco_difference_per_kelvin * tolerances.temperature_span_kelvin,
        ageing=tolerances.ageing,
        noise=2.0 * NOISE_FACTOR * noise_std,
        pulling=2.0 * tolerances.pulling,
        placement=2.0 * tolerances.placement,
    )


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


class CodePlacement:
    """Assignment of codes to sites at (m, 2): sites that couple strongly get distant codes, neighbours two steps."""

    def __init__(self, positions_m: Floats) -> None:
        distance: Floats = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
        np.fill_diagonal(distance, np.inf)
        nearest = distance.min(axis=1)
        usual_m = float(np.median(nearest)) if np.isfinite(nearest).all() else 1.0
        self.neighbours: NDArray[np.bool_] = distance < NEIGHBOUR_FACTOR * usual_m
        self.coupling: Floats = np.exp(-distance / (DECAY_FACTOR * usual_m))
        """(m, m), in no unit: falls with distance as that of trapped modes about does."""

    def place(self, code_count: int, random: np.random.Generator) -> Integers:
        """Give each site one of the codes 1 to `code_count`, none twice; ValueError where they are too few.

        Swaps codes while that does not raise the sum over pairs of (coupling / steps apart)^2, the share that a
        detuned neighbour takes of a site's response, and of a cost for neighbours that are not two steps apart.
        """
        count = len(self.coupling)
        if code_count < count:
            raise ValueError(f"code_count {code_count} must be at least the number of sites, {count}")
        weight, near = np.zeros((2, code_count, code_count))  # codes that no site has belong to sites without coupling
        weight[:count, :count] = (self.coupling / (self.coupling.max() or 1.0)) ** 2
        near[:count, :count] = NEAR_COST * self.neighbours

        def cost(codes: Integers, sites: Integers) -> float:
            apart = np.abs(codes[sites][:, None] - codes).astype(np.float64)
            apart[apart == 0.0] = np.inf  # a site and itself
            return float((weight[sites] / apart**2 + near[sites] * (apart < NEIGHBOUR_STEPS)).sum())

        best, least = np.arange(code_count), np.inf
        for _ in range(STARTS):
            codes = random.permutation(code_count)
            for pair in random.integers(0, [count, code_count], (TRIES_A_SITE * count, 2)):
                swapped = codes.copy()
                swapped[pair] = codes[pair[::-1]]
                if cost(swapped, pair) <= cost(codes, pair):
                    codes = swapped
            if (found := cost(codes, np.arange(count))) < least:
                best, least = codes, found
        return best[:count] + 1

    def too_near(self, codes: Integers) -> list[tuple[int, int]]:
        """Pairs of neighbours whose codes are fewer than two steps apart, the first index below the second."""
        apart = np.abs(codes[:, None] - codes)
        pairs = np.argwhere(np.triu(self.neighbours & (apart < NEIGHBOUR_STEPS), 1))
        return [(int(i), int(j)) for i, j in pairs]
