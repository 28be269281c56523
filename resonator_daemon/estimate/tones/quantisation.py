"""Beats between input and reference: how far rounding of time stamps to ticks is from white noise in a regression.

A stamp that falls at x ticks is off by the sum over h of sin(2 pi h x) / (pi h) when it is rounded. Stamps come every
`interval_ticks`, so that harmonic h is a line at the aliased frequency h interval mod 1 per stamp. White jitter of s
ticks damps its amplitude by exp(-2 pi^2 h^2 s^2) and makes white noise of what it takes (Widrow and Kollar,
Quantization Noise, 2008). Where the interval is close to p/q, line q is slow, does not average out over the window, and
the regression takes it for frequency, by up to 0.57 N times as much as white noise of that power.
"""

import math
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.tones.frequency_estimators import QUANTISATION_TICKS2, Sums

EXCESS_LIMIT: Final = 0.05  # of the variance over 12 s^2 / (N T^2)
STAMPS_MIN: Final = 3
SLOWEST_TURN: Final = 1e-6  # over the window; the regression takes all slower lines for constants
WORST_TURN: Final = 0.7874  # over the window; where the envelope of the response falls below its maximum
JITTER_STEPS: Final = 8
Q2_SIGMAS: Final = 2.0
HARMONICS_MAX: Final = 512  # enough for jitter above a thousandth of a tick
HARMONICS_REACH: Final = 0.6  # harmonics beyond reach / s make less than a tenth of the limit with up to 1e7 stamps
FEW_HARMONICS: Final = 8  # up to so many are added up one by one sooner than as arrays

_HARMONICS: Final[Floats] = np.arange(1.0, 1.0 + HARMONICS_MAX)
_LINES_TICKS2: Final[Floats] = 0.5 / (np.pi * _HARMONICS) ** 2  # powers without jitter
_FIRST_LINE_DAMPING: Final = -4.0 * math.pi**2
_DAMPING: Final[Floats] = -((2.0 * np.pi * _HARMONICS) ** 2)
_FEW_LINES: Final[list[tuple[float, float, float]]] = list(
    zip(*(table[:FEW_HARMONICS].tolist() for table in (_HARMONICS, _LINES_TICKS2, _DAMPING)), strict=True)
)


def quantisation_excess(interval_ticks: npt.ArrayLike, jitter_ticks: npt.ArrayLike, stamps: npt.ArrayLike) -> Floats:
    """Variance of a regression's frequency over the bound of white noise, 12 (s^2 + 1/12) / (N T^2), less 1.

    Mean over the phase of the first stamp within its tick. Below 0 where beats help. NaN where `interval_ticks` is.

    Parameters
    ----------
    interval_ticks
        Between stamps, stride f_ref / f.
    jitter_ticks
        Standard deviation s of a stamp before it is rounded.
    stamps
        N, at least 3. All three broadcast.
    """
    return _excess(interval_ticks, jitter_ticks, stamps, _gain)


def excess_bound(interval_ticks: npt.ArrayLike, jitter_ticks: npt.ArrayLike, stamps: npt.ArrayLike) -> Floats:
    """Largest excess that an interval as measured allows; parameters as of `quantisation_excess`.

    Rounding moves the measured interval by a part of a turn over the window, or to p/q itself. So lines count by the
    envelope of the regression's response, slow ones as if they were the worst.
    """
    return _excess(interval_ticks, jitter_ticks, stamps, _gain_bound)


def excess_bound_of_one(interval_ticks: float, jitter_ticks: float, stamps: int) -> float:
    """`excess_bound` of one tone, in plain floats where few lines count: arrays of three take ten times as long."""
    if jitter_ticks * FEW_HARMONICS <= HARMONICS_REACH:
        return float(excess_bound(interval_ticks, jitter_ticks, stamps))
    jitter_ticks2 = jitter_ticks * jitter_ticks
    steepest, slowest = stamps * stamps - 1.0, WORST_TURN / stamps
    scale = 3.0 / (stamps * steepest)
    excess_ticks2 = 0.0
    for harmonic, line_ticks2, damping in _FEW_LINES[: 1 + int(HARMONICS_REACH / jitter_ticks)]:
        turns = harmonic * interval_ticks
        off = abs(turns - round(turns))
        sine = math.sin(math.pi * (off if off > slowest else slowest))
        sine2 = sine * sine
        gain = (1.0 / sine2 + steepest) / sine2 * scale
        excess_ticks2 += line_ticks2 * math.exp(damping * jitter_ticks2) * (gain - 1.0)
    return excess_ticks2 / (jitter_ticks2 + QUANTISATION_TICKS2)


def beats(interval_ticks: npt.ArrayLike, jitter_ticks: npt.ArrayLike, stamps: npt.ArrayLike) -> NDArray[np.bool_]:
    """Return where `excess_bound` exceeds EXCESS_LIMIT: the counter's stated noise may be too small there."""
    return excess_bound(interval_ticks, jitter_ticks, stamps) > EXCESS_LIMIT


def stamp_jitter_ticks(sums: Sums) -> float:
    """Jitter of stamps before rounding, from their second differences; rather too small than too large.

    Without jitter rounding makes second differences of 0, 1 and -1 as the interval has it: between none at a whole
    number of ticks and twice those of white noise half a tick from it. Jitter damps the surplus, at first order by
    exp(-4 pi^2 s^2); the smallest jitter is taken that explains Q2 less its own noise. While a stamp stays at the edge
    between two ticks for a whole record, little jitter is taken for up to 0.4 ticks: where the jitter is known, use it.
    """
    count = sums.second_differences
    least_ticks2 = sums.q2_ticks2 / (6 * count) * max(1.0 - Q2_SIGMAS * math.sqrt(140.0 / 36.0 / count), 0.0)
    surely_ticks2 = least_ticks2 - QUANTISATION_TICKS2
    if surely_ticks2 <= 0.0:
        return 0.0
    part = sums.span_ticks % (sums.stamps - 1) / (sums.stamps - 1)
    surplus_ticks2 = (part if part < 0.5 else 1.0 - part) / 3.0 - QUANTISATION_TICKS2
    if surplus_ticks2 <= 0.0:
        return math.sqrt(surely_ticks2)
    jitter_ticks2 = 0.0
    for _ in range(JITTER_STEPS):
        before_ticks2 = jitter_ticks2
        explained_ticks2 = surely_ticks2 - surplus_ticks2 * math.exp(_FIRST_LINE_DAMPING * jitter_ticks2)
        jitter_ticks2 = explained_ticks2 if explained_ticks2 > 0.0 else 0.0
        if jitter_ticks2 == before_ticks2:
            break
    return math.sqrt(jitter_ticks2)


def _excess(
    interval_ticks: npt.ArrayLike,
    jitter_ticks: npt.ArrayLike,
    stamps: npt.ArrayLike,
    gain: Callable[[Floats, Floats], Floats],
) -> Floats:
    """Sum the lines, each by the `gain` that the regression has for its turns per stamp and the number of stamps."""
    interval = np.asarray(interval_ticks, np.float64)[..., np.newaxis]
    jitter = np.asarray(jitter_ticks, np.float64)[..., np.newaxis]
    count = np.asarray(stamps, np.float64)[..., np.newaxis]
    fewest, smallest = float(count.min()), float(jitter.min())
    if not (fewest >= STAMPS_MIN and smallest >= 0.0):
        raise ValueError(f"{fewest:.0f} stamps, at least {STAMPS_MIN}; jitter of {smallest} ticks, at least 0")
    reach = HARMONICS_MAX if smallest * HARMONICS_MAX <= HARMONICS_REACH else 1 + int(HARMONICS_REACH / smallest)
    turns = _HARMONICS[:reach] * interval
    jitter_ticks2 = jitter * jitter
    lines_ticks2 = _LINES_TICKS2[:reach] * np.exp(_DAMPING[:reach] * jitter_ticks2)
    off_white_ticks2 = lines_ticks2 * (gain(np.abs(turns - np.rint(turns)), count) - 1.0)
    excess: Floats = (off_white_ticks2 / (jitter_ticks2 + QUANTISATION_TICKS2)).sum(axis=-1)
    return excess


def _gain(turns: Floats, stamps: Floats) -> Floats:
    """Variance of a slope from a line of random phase, over that from white noise of its power; `turns` per stamp."""
    half = np.pi * np.maximum(turns, SLOWEST_TURN / stamps)
    phase = stamps * half
    # sum (k - c) sin(2 half (k - c)) over the stamps, c their middle.
    ramp = (np.sin(phase) / np.tan(half) - stamps * np.cos(phase)) / (2.0 * np.sin(half))
    gain: Floats = ramp * ramp * (12.0 / (stamps * (stamps * stamps - 1.0)))
    return gain


def _gain_bound(turns: Floats, stamps: Floats) -> Floats:
    """Envelope of `_gain`, up to its maximum."""
    sine2 = np.sin(np.pi * np.maximum(turns, WORST_TURN / stamps)) ** 2
    # cot^2 + N^2 is the square of the amplitude of the ramp's sine and cosine.
    gain: Floats = (1.0 / sine2 - 1.0 + stamps * stamps) / sine2 * (3.0 / (stamps * (stamps * stamps - 1.0)))
    return gain
