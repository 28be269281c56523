"""Tone of one channel in a window, and its errors: stamps, beats with the reference, other tones.

All of it is of one tone and in plain floats: it is worked out for each channel some hundred times a second, and arrays
of four numbers take ten times as long.

Beats with the reference. A stamp that falls at x ticks is off by the sum over h of sin(2 pi h x) / (pi h) when it is
rounded to ticks. Stamps come every `interval_ticks`, so that harmonic h is a line at the aliased frequency h interval
mod 1 per stamp. White jitter of s ticks damps its amplitude by exp(-2 pi^2 h^2 s^2) and makes white noise of what it
takes (Widrow and Kollar, Quantization Noise, 2008). Where the interval is close to p/q, line q is slow, does not
average out over the window, and the regression takes it for frequency, by up to 0.57 N times as much as white noise of
that power.

Other tones. A tone of amplitude ratio r shifts each edge by up to r / (2 pi f), a beat's phase at a time. The
regression lets through none of it but a little that looks like a line: what is left of the first and the last stamp
gives r. Second differences of stamps hardly contain a beat of less than a tenth of the stamps' rate, so that they still
give the noise. The regression's own error has an amplitude of up to 3 r / (pi^2 d T^2) for a distance d and a window T.
Of the pilot, ratio and distance are known, so that its error is computed; of any other tone, the largest is stated.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.tones.frequency_estimators import (
    QUANTISATION_TICKS2,
    Sums,
    regression_std,
    stamp_std_ticks,
)
from resonator_daemon.estimate.tones.tone_detector import PILOT_TOLERANCE

EXCESS_CAP: Final = 1e6  # of the counter's variance; a beat that slow is worth nothing
EXCESS_LIMIT: Final = 0.05  # of the variance over 12 s^2 / (N T^2)
WORST_TURN: Final = 0.7874  # over the window; where the envelope of the response falls below its maximum
JITTER_STEPS: Final = 8
Q2_SIGMAS: Final = 2.0
HARMONICS_MAX: Final = 512  # enough for jitter above a thousandth of a tick
HARMONICS_REACH: Final = 0.6  # harmonics beyond reach / s make less than a tenth of the limit with up to 1e7 stamps
FEW_HARMONICS: Final = 8  # up to so many are added up one by one sooner than as arrays
RESIDUAL_LIMIT: Final = 8.0  # times what noise and pilot explain: beyond all of 22 000 windows of single touches
STILL_BEAT: Final = 1e-6  # radians, half of what the beat turns in a window: one so slow changes no frequency

_HARMONICS: Final[Floats] = np.arange(1.0, 1.0 + HARMONICS_MAX)
_LINES_TICKS2: Final[Floats] = 0.5 / (np.pi * _HARMONICS) ** 2  # powers without jitter
_DAMPING: Final[Floats] = -((2.0 * np.pi * _HARMONICS) ** 2)
_FEW_LINES: Final[list[tuple[float, float, float]]] = list(
    zip(*(table[:FEW_HARMONICS].tolist() for table in (_HARMONICS, _LINES_TICKS2, _DAMPING)), strict=True)
)


class ToneCount(NamedTuple):
    """Frequency and relative noise of a tone, with flags for a second tone and for beats with the reference."""

    frequency_hz: float
    std: float
    others: bool
    beats: bool


NO_TONE: Final = ToneCount(math.nan, math.nan, others=False, beats=False)


def count_tone(
    sums: Sums,
    frequency_hz: float,
    residual_ticks2: float,
    *,
    reference_hz: float,
    pilot_hz: float,
    over_pilot_db: float,
    distance_hz: float,
    window_s: float,
) -> ToneCount:
    """Return the tone that a channel counts, and its errors.

    Parameters
    ----------
    sums, frequency_hz
        Of the window.
    residual_ticks2
        Mean square that the lines of its gates leave at their ends.
    pilot_hz
        As last measured: a beat that turns by half a radian more has another effect.
    over_pilot_db
        By how much more the tone was attenuated, or less, than the pilot when that was counted last: so strong may the
        pilot still be next to it. NaN where it never was.
    distance_hz
        Smallest possible distance of another tone. A beat in step with the gates does not scatter their ends.
    """
    stamps, noise_ticks = sums.stamps, stamp_std_ticks(sums)
    window_std = regression_std(noise_ticks, stamps, sums.span_ticks)
    interval_ticks = sums.stride_edges * reference_hz / frequency_hz
    excess = excess_bound(interval_ticks, stamp_jitter_ticks(sums), stamps)
    excess = 0.0 if excess < 0.0 else EXCESS_CAP if excess > EXCESS_CAP else excess
    noise_ticks2 = noise_ticks * noise_ticks
    ratio = 1.0 if math.isnan(over_pilot_db) else min(10.0 ** (over_pilot_db / 20.0), 1.0)
    others = has_other_tone(residual_ticks2, noise_ticks2, pilot_residual_ticks2(ratio, frequency_hz, reference_hz))
    beat_hz = pilot_beat_std_hz(ratio, frequency_hz, pilot_hz, frequency_hz / sums.stride_edges, window_s)
    if others:  # the scatter at the ends of gates bounds the strength of the other tone
        surplus_ticks2 = max(residual_ticks2 - noise_ticks2, 0.0)
        other_ratio = min(math.sqrt(2.0 * surplus_ticks2) * 2.0 * math.pi * frequency_hz / reference_hz, 1.0)
        beat_hz = max(beat_hz, 3.0 * other_ratio / (math.pi**2 * distance_hz * window_s**2) / math.sqrt(2.0))
    std = math.sqrt(window_std**2 * (1.0 + excess) + (beat_hz / frequency_hz) ** 2)
    return ToneCount(frequency_hz, std, others, excess > EXCESS_LIMIT)


def excess_bound(interval_ticks: float, jitter_ticks: float, stamps: int) -> float:
    """Return the largest variance of a regression's frequency over 12 (s^2 + 1/12) / (N T^2), less 1.

    Rounding moves the measured interval by a part of a turn over the window, or to p/q itself. So lines count by the
    envelope of the regression's response, slow ones as if they were the worst.

    Parameters
    ----------
    interval_ticks
        Between stamps, stride f_ref / f, as measured.
    jitter_ticks
        Standard deviation s of a stamp before it is rounded.
    stamps
        N, at least 3.
    """
    jitter_ticks2 = jitter_ticks * jitter_ticks
    # cot^2 + N^2 is the square of the amplitude of the sine and cosine in the regression's response.
    steepest, slowest = stamps * stamps - 1.0, WORST_TURN / stamps
    scale = 3.0 / (stamps * steepest)
    if jitter_ticks * FEW_HARMONICS <= HARMONICS_REACH:
        lines = slice(1 + int(HARMONICS_REACH / max(jitter_ticks, HARMONICS_REACH / HARMONICS_MAX)))
        all_turns = _HARMONICS[lines] * interval_ticks
        sines2 = np.sin(np.pi * np.maximum(np.abs(all_turns - np.rint(all_turns)), slowest)) ** 2
        lines_ticks2 = _LINES_TICKS2[lines] * np.exp(_DAMPING[lines] * jitter_ticks2)
        excess_ticks2 = float(lines_ticks2 @ ((1.0 / sines2 + steepest) / sines2 * scale - 1.0))
        return excess_ticks2 / (jitter_ticks2 + QUANTISATION_TICKS2)
    excess_ticks2 = 0.0
    for harmonic, line_ticks2, damping in _FEW_LINES[: 1 + int(HARMONICS_REACH / jitter_ticks)]:
        turns = harmonic * interval_ticks
        off = abs(turns - round(turns))
        sine = math.sin(math.pi * (off if off > slowest else slowest))
        sine2 = sine * sine
        gain = (1.0 / sine2 + steepest) / sine2 * scale
        excess_ticks2 += line_ticks2 * math.exp(damping * jitter_ticks2) * (gain - 1.0)
    return excess_ticks2 / (jitter_ticks2 + QUANTISATION_TICKS2)


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
        explained_ticks2 = surely_ticks2 - surplus_ticks2 * math.exp(_FEW_LINES[0][2] * jitter_ticks2)
        jitter_ticks2 = explained_ticks2 if explained_ticks2 > 0.0 else 0.0
        if jitter_ticks2 == before_ticks2:
            break
    return math.sqrt(jitter_ticks2)


def pilot_residual_ticks2(ratio: float, frequency_hz: float, reference_hz: float) -> float:
    """Return the mean square shift of edges of `frequency_hz` by a tone of amplitude `ratio`."""
    moved_ticks = ratio * reference_hz / (2.0 * math.pi * frequency_hz)
    return moved_ticks * moved_ticks / 2.0


def has_other_tone(residual_ticks2: float, noise_ticks2: float, pilot_ticks2: float) -> bool:
    """Return whether the ends of a window's gates lie off their lines by more than noise and pilot explain."""
    return residual_ticks2 > RESIDUAL_LIMIT * (noise_ticks2 + pilot_ticks2)


def pilot_beat_std_hz(
    ratio: float, frequency_hz: float, pilot_hz: float, stamp_rate_hz: float, window_s: float
) -> float:
    """Return the standard deviation that the beat with the pilot adds to a window's frequency, over all its phases.

    It is 3 r |cos x - sin(x)/x| / (sqrt(2) pi^2 D T^2) with x = pi D T, for the distance D that the stamps see.
    """
    if abs(frequency_hz / pilot_hz - 1.0) < PILOT_TOLERANCE:  # the pilot itself
        return 0.0
    turns = (frequency_hz - pilot_hz) / stamp_rate_hz
    distance_hz = abs(turns - round(turns)) * stamp_rate_hz
    x = math.pi * distance_hz * window_s
    if x < STILL_BEAT:
        return 0.0
    response = abs(math.cos(x) - math.sin(x) / x)
    return 3.0 * ratio * response / (math.sqrt(2.0) * math.pi**2 * distance_hz * window_s**2)
