"""A counter's record to what one gate tells; or why it tells nothing: the board says so, or no tone has such sums."""

import math
from functools import cache
from typing import Final, NamedTuple

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.measurement.counting import FREQUENCY_JUMP, QUANTISATION_TICKS2, Sums
from resonator_daemon.measurement.other_tones import end_residual_ticks2

STAMPS_MIN: Final = 3  # two give a slope but say nothing about their noise
LINE_TOLERANCE: Final = 64  # stamps lie within 1/64 of the span of the line through the end points
NOISE_SIGMAS: Final = 6.0

_FLAG_FAULTS: Final = (
    (RecordFlag.NO_SIGNAL, "no_signal"),
    (RecordFlag.OVERFLOW, "overflow"),
    (RecordFlag.CAPTURE_SWITCH, "capture_switch"),
    (RecordFlag.LOST_EDGE, "lost_edge"),
    (RecordFlag.SATURATED, "saturated"),
)
_UNUSABLE: Final = sum(int(flag) for flag, _ in _FLAG_FAULTS)


class Gate(NamedTuple):
    """One gate of one channel: its sums, frequency by regression, and what the line leaves of its ends, mean square."""

    sums: Sums
    frequency_hz: float
    residual_ticks2: float


def read_gate(record: SingleToneRecord, reference_hz: float) -> Gate | str:
    """Return what a record tells, or why it gives no frequency: the board says so, or no steady tone has such sums."""
    # Four times a frame: one slope serves the checks, the frequency as `counting.frequency_hz` has it and the residual;
    # tuples are made without the detour of their classes.
    new_tuple = tuple.__new__
    first_edge, first_ticks, stamps, stride_edges, span, s1, s2, q2, _, flags = record
    if flags & _UNUSABLE:
        return _flag_fault(flags & _UNUSABLE)
    if stamps < STAMPS_MIN or stride_edges == 0 or span < stamps - 1:
        return "impossible_counts"
    # On the line through the end points S1 = N u / 2 and S2 = N (2N - 1) u / 6.
    steps, line = stamps - 1, stamps * span
    slack = stamps * (span // LINE_TOLERANCE + 1)
    if abs(2 * s1 - line) > 2 * slack or abs(6 * s2 - (stamps + steps) * line) > 3 * steps * slack:
        return "impossible_counts"
    # Regression and end points give one frequency but for noise and the chirp of a press.
    slope_numerator = 6 * (2 * s2 - steps * s1)
    if slope_numerator <= 0:
        return "impossible_counts"
    slope_denominator = stamps * (stamps * stamps - 1)
    slope = slope_numerator / slope_denominator
    end_points = span / steps
    differences = stamps - 2
    # A second difference of stamps has six times the variance of one, the distance of two has twice that.
    if q2 > 3 * differences * end_points * end_points:
        return "impossible_counts"  # stamps that scatter by more than their distance are not in order
    off = abs(slope / end_points - 1.0)
    if off > FREQUENCY_JUMP:  # up to which no noise is needed to explain it
        noise_ticks = math.sqrt(2.0 * max(q2 / (6 * differences), QUANTISATION_TICKS2))
        if off > FREQUENCY_JUMP + NOISE_SIGMAS * noise_ticks / span:
            return "impossible_counts"
    sums = new_tuple(Sums, (first_edge, first_ticks, stamps, stride_edges, span, s1, s2, q2, differences))
    gate_hz = reference_hz * (stride_edges * slope_denominator / slope_numerator)
    return new_tuple(Gate, (sums, gate_hz, end_residual_ticks2(stamps, span, s1, slope)))


@cache
def _flag_fault(unusable: int) -> str:
    """Name the first of these flags."""
    return next(name for flag, name in _FLAG_FAULTS if unusable & flag)
