"""Tone of one channel in a window, and its errors: stamps, beats with the reference, other tones.

All of it is of one tone and in plain floats: it is worked out for each channel some hundred times a second, and arrays
of four numbers take ten times as long.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from resonator_daemon.estimate.tones.frequency_estimators import Sums, regression_std, stamp_std_ticks
from resonator_daemon.estimate.tones.other_tones import (
    beat_bound_hz,
    beat_std_hz,
    has_other_tone,
    pilot_residual_ticks2,
)
from resonator_daemon.estimate.tones.quantisation import EXCESS_LIMIT, excess_bound_of_one, stamp_jitter_ticks

EXCESS_CAP: Final = 1e6  # of the counter's variance; a beat that slow is worth nothing


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
    gate_hz: Sequence[float],
    gate_residual_ticks2: Sequence[float],
    *,
    reference_hz: float,
    over_pilot_db: float,
    distance_hz: float,
    window_s: float,
) -> ToneCount:
    """Return the tone that a channel counts, and its errors.

    Parameters
    ----------
    sums, frequency_hz
        Of the window.
    gate_hz, gate_residual_ticks2
        Of the gates that it consists of.
    over_pilot_db
        By how much more the tone was attenuated, or less, than the pilot when that was counted last: so strong may the
        pilot still be next to it. NaN where it never was.
    distance_hz
        The least that another tone may be away.
    """
    frames = len(gate_hz)
    stamps, noise_ticks = sums.stamps, stamp_std_ticks(sums)
    window_std = regression_std(noise_ticks, stamps, sums.span_ticks)
    interval_ticks = sums.stride_edges * reference_hz / frequency_hz
    excess = excess_bound_of_one(interval_ticks, stamp_jitter_ticks(sums), stamps)
    excess = 0.0 if excess < 0.0 else EXCESS_CAP if excess > EXCESS_CAP else excess
    noise_ticks2 = noise_ticks * noise_ticks
    residual_ticks2 = sum(gate_residual_ticks2) / frames
    ratio = 1.0 if math.isnan(over_pilot_db) else min(10.0 ** (over_pilot_db / 20.0), 1.0)
    others = has_other_tone(residual_ticks2, noise_ticks2, pilot_residual_ticks2(ratio, frequency_hz, reference_hz))
    beat_hz = beat_std_hz(gate_hz, frequency_hz * window_std * frames**1.5)
    if others:
        bound_hz = beat_bound_hz(residual_ticks2, noise_ticks2, frequency_hz, reference_hz, distance_hz, window_s)
        beat_hz = max(beat_hz, bound_hz)
    std = math.sqrt(window_std**2 * (1.0 + excess) + (beat_hz / frequency_hz) ** 2)
    return ToneCount(frequency_hz, std, others, excess > EXCESS_LIMIT)
