"""Records of a counter that give no frequency, and why: what the board says of them, and sums that no tone has."""

import math
from typing import Final

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.measurement.counting import FREQUENCY_JUMP, Sums, stamp_std_ticks

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


def fault(record: SingleToneRecord) -> str | None:
    """Why a record gives no frequency: the board says so, or no steady tone has such sums; None where it does."""
    if record.flags & _UNUSABLE:
        return next(name for flag, name in _FLAG_FAULTS if record.flags & flag)
    stamps, span = record.stamps, record.span_ticks
    if stamps < STAMPS_MIN or record.stride_edges == 0 or span < stamps - 1:
        return "impossible_counts"
    # On the line through the end points S1 = N u / 2 and S2 = N (2N - 1) u / 6.
    slack = span // LINE_TOLERANCE + 1
    if abs(2 * record.s1_ticks - stamps * span) > 2 * stamps * slack:
        return "impossible_counts"
    if abs(6 * record.s2_ticks - stamps * (2 * stamps - 1) * span) > 3 * stamps * (stamps - 1) * slack:
        return "impossible_counts"
    # Regression and end points give one frequency but for noise and the chirp of a press.
    slope_numerator = 6 * (2 * record.s2_ticks - (stamps - 1) * record.s1_ticks)
    if slope_numerator <= 0:
        return "impossible_counts"
    slope = slope_numerator / (stamps * (stamps * stamps - 1))
    end_points = span / (stamps - 1)
    sums = Sums.of(record)
    noise_ticks = math.sqrt(2.0) * stamp_std_ticks(sums)
    if noise_ticks > end_points:
        return "impossible_counts"  # stamps that scatter by more than their distance are not in order
    if abs(slope / end_points - 1.0) > FREQUENCY_JUMP + NOISE_SIGMAS * noise_ticks / span:
        return "impossible_counts"
    return None
