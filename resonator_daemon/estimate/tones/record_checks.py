"""Records of a single-tone counter: the sums and the frequency of each gate, or the fault of its record."""

import math
from collections.abc import Iterable
from typing import Final

from firmware_protocol.layouts import RecordFlag
from resonator_daemon.estimate.tones.frequency_estimators import FREQUENCY_JUMP, QUANTISATION_TICKS2, PlainSums

STAMPS_MIN: Final = 3  # two give a slope but no estimate of its noise
LINE_TOLERANCE: Final = 64  # stamps lie within 1/64 of the span of the line through the end points
NOISE_SIGMAS: Final = 6.0

_FLAGS: Final = (
    RecordFlag.NO_SIGNAL,
    RecordFlag.OVERFLOW,
    RecordFlag.CAPTURE_SWITCH,
    RecordFlag.LOST_EDGE,
    RecordFlag.SATURATED,
)  # in order of precedence
FAULTS_IN_WORDS: Final = {
    "no_signal": "no signal",
    "overflow": "its counter overflowed",
    "capture_switch": "its tone changed within a gate",
    "lost_edge": "an edge was lost",
    "saturated": "its input is saturated",
    "impossible_counts": "its counts are impossible",
    "impossible_frequency": "its frequency is impossible",
}
FAULTS: Final = (None, *FAULTS_IN_WORDS)
"""Faults of records by code, those of `_FLAGS` first; 0: none."""
CAPTURE_SWITCH, IMPOSSIBLE_COUNTS, IMPOSSIBLE_FREQUENCY = map(
    FAULTS.index, ("capture_switch", "impossible_counts", "impossible_frequency")
)
_UNUSABLE: Final = sum(map(int, _FLAGS))
_FAULT_OF_FLAGS: Final = [
    next((code for code, flag in enumerate(_FLAGS, 1) if flags & flag), 0) for flags in range(_UNUSABLE + 1)
]

Gate = tuple[PlainSums, float, float]
"""One record: its sums, the frequency of its regression in Hz, and the mean square residual, in ticks^2, of the first
and the last stamp from its line."""


def read_gates(
    records: Iterable[tuple[int, ...]], reference_hz: float, band_hz: tuple[float, float]
) -> list[Gate | int]:
    """Return the gate of each record, the fields of `SingleToneRecord`, or the code of its fault.

    A record has a fault where the board flags it, where no steady tone has such sums, and outside of `band_hz`.
    """
    gates: list[Gate | int] = []
    for record in records:
        first_edge, first_ticks, stamps, stride_edges, span_ticks, s1_ticks, s2_ticks, q2_ticks2, _, flags = record
        if code := _FAULT_OF_FLAGS[flags & _UNUSABLE]:
            gates.append(code)
            continue
        gates.append(IMPOSSIBLE_COUNTS)  # unless all checks are passed
        if stamps < STAMPS_MIN or stride_edges == 0 or span_ticks < stamps - 1:
            continue
        count, span, s1, s2, q2 = float(stamps), float(span_ticks), float(s1_ticks), float(s2_ticks), float(q2_ticks2)
        steps, line = count - 1.0, count * span
        # Regression and end points give one frequency but for noise and the chirp of a press.
        slope_numerator = 6.0 * (2.0 * s2 - steps * s1)
        if slope_numerator <= 0.0:
            continue
        slope_denominator = count * (count * count - 1.0)
        slope = slope_numerator / slope_denominator
        interval = span / steps
        # A second difference of stamps has six times the variance of one, the distance of two has twice that.
        stamp_variance = q2 / (6.0 * (count - 2.0))
        # On the line through the end points S1 = N u / 2 and S2 = N (2N - 1) u / 6.
        slack = count * (span / LINE_TOLERANCE + 1.0)
        if (
            abs(2.0 * s1 - line) > 2.0 * slack
            or abs(6.0 * s2 - (count + steps) * line) > 3.0 * steps * slack
            or stamp_variance > interval * interval / 2.0  # out of order
        ):
            continue
        off = abs(slope / interval - 1.0)
        if off > FREQUENCY_JUMP:  # up to that no noise is needed to explain the difference
            noise_ticks = math.sqrt(2.0 * max(stamp_variance, QUANTISATION_TICKS2))
            if off > FREQUENCY_JUMP + NOISE_SIGMAS * noise_ticks / span:
                continue
        frequency_hz = reference_hz * (stride_edges * slope_denominator / slope_numerator)
        if not band_hz[0] <= frequency_hz <= band_hz[1]:
            gates[-1] = IMPOSSIBLE_FREQUENCY
            continue
        middle, half = s1 / count, slope * steps / 2
        residual_ticks2 = ((middle - half) ** 2 + (span - middle - half) ** 2) / 2
        sums = first_edge, first_ticks, stamps, stride_edges, span_ticks, s1_ticks, s2_ticks, q2_ticks2, stamps - 2
        gates[-1] = sums, frequency_hz, residual_ticks2
    return gates
