"""Records of a single-tone counter: the sums and the frequency of each gate, or the fault of its record."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import SINGLE_TONE_FIELDS, RecordFlag
from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.tones.frequency_estimators import FREQUENCY_JUMP, QUANTISATION_TICKS2, PlainSums
from resonator_daemon.estimate.tones.other_tones import end_residual_ticks2

STAMPS_MIN: Final = 3  # two give a slope but no estimate of its noise
LINE_TOLERANCE: Final = 64  # stamps lie within 1/64 of the span of the line through the end points
NOISE_SIGMAS: Final = 6.0

RECORD: Final = np.dtype([(field.name, "<" + field.code) for field in SINGLE_TONE_FIELDS])
"""A record on the wire."""

FAULTS: Final = (
    None,
    "no_signal",
    "overflow",
    "capture_switch",
    "lost_edge",
    "saturated",
    "impossible_counts",
    "impossible_frequency",
)
"""Faults of records by code; 0: none."""
FAULTS_IN_WORDS: Final = {
    "no_signal": "no signal",
    "overflow": "its counter overflowed",
    "capture_switch": "its tone changed within a gate",
    "lost_edge": "an edge was lost",
    "saturated": "its input is saturated",
    "impossible_counts": "its counts are impossible",
    "impossible_frequency": "its frequency is impossible",
}
CAPTURE_SWITCH, IMPOSSIBLE_COUNTS, IMPOSSIBLE_FREQUENCY = map(FAULTS.index, FAULTS[3:4] + FAULTS[6:])

_FLAGS: Final = (
    RecordFlag.NO_SIGNAL,
    RecordFlag.OVERFLOW,
    RecordFlag.CAPTURE_SWITCH,
    RecordFlag.LOST_EDGE,
    RecordFlag.SATURATED,
)  # the first one that is set counts
_UNUSABLE: Final = sum(map(int, _FLAGS))
_FAULT_OF_FLAGS: Final = np.array(
    [next((code for code, flag in enumerate(_FLAGS, 1) if flags & flag), 0) for flags in range(_UNUSABLE + 1)], np.int8
)
_FAULT_CODES: Final[list[int]] = _FAULT_OF_FLAGS.tolist()
_EXACT: Final = (
    "first_edge",
    "first_ticks",
    "stamps",
    "stride_edges",
    "span_ticks",
    "s1_ticks",
    "s2_ticks",
    "q2_ticks2",
)


Gate = tuple[PlainSums, float, float]
"""One record: its sums, the frequency of its regression in Hz, and `Gates.residual_ticks2`."""


class Gates(NamedTuple):
    """Sums, faults and frequencies of records, arrays (..., channels).

    `sums` (8, ..., channels) are the integers of the records, `fault` the codes of `FAULTS`. `frequency_hz` is the
    regression's, NaN where there is a fault. `residual_ticks2` is the mean square that its line leaves at first and
    last stamp.
    """

    sums: NDArray[np.int64]
    fault: NDArray[np.int8]
    frequency_hz: Floats
    residual_ticks2: Floats


def read_gates(records: NDArray[np.void], reference_hz: float, band_hz: tuple[float, float]) -> Gates:
    """Return sums, faults and frequencies of records (..., channels) of the type `RECORD`.

    A record has a fault where the board flags it, where no steady tone has such sums, and outside of `band_hz`. The
    elements are computed one by one: the others change no bit of a result.
    """
    sums = np.empty((len(_EXACT), *records.shape), np.int64)
    for field, name in zip(sums, _EXACT, strict=True):
        field[...] = records[name]  # beyond 2^63 negative, which no tone has
    fault = _FAULT_OF_FLAGS[records["flags"] & _UNUSABLE]
    _, _, stamps, stride_edges, span, s1, s2, q2 = sums.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        steps, line = stamps - 1.0, stamps * span
        # Regression and end points give one frequency but for noise and the chirp of a press.
        slope_numerator = 6.0 * (2.0 * s2 - steps * s1)
        slope_denominator = stamps * (stamps * stamps - 1.0)
        slope = slope_numerator / slope_denominator
        interval = span / steps
        differences = stamps - 2.0
        # A second difference of stamps has six times the variance of one, the distance of two has twice that.
        stamp_variance = q2 / (6.0 * differences)
        noise_ticks = np.sqrt(2.0 * np.maximum(stamp_variance, QUANTISATION_TICKS2))
        # On the line through the end points S1 = N u / 2 and S2 = N (2N - 1) u / 6.
        slack = stamps * (span / LINE_TOLERANCE + 1.0)
        sound = (
            (np.abs(2.0 * s1 - line) <= 2.0 * slack)
            & (np.abs(6.0 * s2 - (stamps + steps) * line) <= 3.0 * steps * slack)
            & (slope_numerator > 0.0)
            # Stamps that scatter by more than their distance are not in order.
            & (stamp_variance <= interval * interval / 2.0)
            # Up to FREQUENCY_JUMP no noise is needed to explain the difference.
            & (np.abs(slope / interval - 1.0) <= FREQUENCY_JUMP + NOISE_SIGMAS * noise_ticks / span)
            & (stamps >= STAMPS_MIN)
            & (np.minimum(stride_edges, span - steps + 1.0) >= 1.0)
            & (q2 >= 0.0)
        )
        frequency_hz = reference_hz * (stride_edges * slope_denominator / slope_numerator)
        within = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
        residual_ticks2 = end_residual_ticks2(stamps, span, s1, slope)
    if not (sound & within).all() or fault.any():
        fault = np.where(
            fault == 0, np.where(sound, np.where(within, 0, IMPOSSIBLE_FREQUENCY), IMPOSSIBLE_COUNTS), fault
        ).astype(np.int8)
        frequency_hz[fault != 0] = np.nan
    return Gates(sums, fault, frequency_hz, residual_ticks2)


def read_gate(record: tuple[int, ...], reference_hz: float, band_hz: tuple[float, float]) -> Gate | int:
    """Return what `read_gates` does of one record, the fields of `SingleToneRecord`, or the code of its fault.

    Arrays of a few records take longer than plain floats, which are rounded alike.
    """
    first_edge, first_ticks, stamps, stride_edges, span_ticks, s1_ticks, s2_ticks, q2_ticks2, _, flags = record
    if code := _FAULT_CODES[flags & _UNUSABLE]:
        return code
    if stamps < STAMPS_MIN or stride_edges == 0 or span_ticks < stamps - 1:
        return IMPOSSIBLE_COUNTS
    count, span, s1, s2, q2 = float(stamps), float(span_ticks), float(s1_ticks), float(s2_ticks), float(q2_ticks2)
    steps, line = count - 1.0, count * span
    slope_numerator = 6.0 * (2.0 * s2 - steps * s1)
    if slope_numerator <= 0.0:
        return IMPOSSIBLE_COUNTS
    slope_denominator = count * (count * count - 1.0)
    slope = slope_numerator / slope_denominator
    interval = span / steps
    stamp_variance = q2 / (6.0 * (count - 2.0))
    slack = count * (span / LINE_TOLERANCE + 1.0)
    if (
        abs(2.0 * s1 - line) > 2.0 * slack
        or abs(6.0 * s2 - (count + steps) * line) > 3.0 * steps * slack
        or stamp_variance > interval * interval / 2.0
    ):
        return IMPOSSIBLE_COUNTS
    off = abs(slope / interval - 1.0)
    if off > FREQUENCY_JUMP:
        noise_ticks = math.sqrt(2.0 * max(stamp_variance, QUANTISATION_TICKS2))
        if off > FREQUENCY_JUMP + NOISE_SIGMAS * noise_ticks / span:
            return IMPOSSIBLE_COUNTS
    frequency_hz = reference_hz * (stride_edges * slope_denominator / slope_numerator)
    if not band_hz[0] <= frequency_hz <= band_hz[1]:
        return IMPOSSIBLE_FREQUENCY
    middle, half = s1 / count, slope * steps / 2  # as of `end_residual_ticks2`
    residual_ticks2 = ((middle - half) ** 2 + (span - middle - half) ** 2) / 2
    sums = first_edge, first_ticks, stamps, stride_edges, span_ticks, s1_ticks, s2_ticks, q2_ticks2, stamps - 2
    return sums, frequency_hz, residual_ticks2
