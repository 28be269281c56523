"""Frequency from a counter's integer sums: merging, regression slope, noise, and the sliding window of one channel.

Integers stay exact until the one division that makes a frequency. Regression of stamp time on edge number is the Omega
counter of Rubiola et al. (2016); definitions of the sums are in `firmware_protocol.layouts`.
"""

import math
from collections import deque
from collections.abc import Iterable
from typing import Final, NamedTuple, Self

from firmware_protocol.layouts import RecordFlag, SingleToneRecord

WRAP_MASK: Final = 0xFFFFFFFF  # edge and tick counters are 32 bits wide on the wire
STAMPS_MIN: Final = 3  # two give a slope but say nothing about their noise
LINE_TOLERANCE: Final = 64  # stamps lie within 1/64 of the span of the line through the end points
NOISE_SIGMAS: Final = 6.0
FREQUENCY_JUMP: Final = 20e-6  # between adjacent gates; a press of 3 N/ms at 6.3e-6 / N stays below it
QUANTISATION_TICKS2: Final = 1 / 12  # variance of a stamp rounded to whole ticks
OSCILLATOR_STD_1S: Final = 3e-10  # white frequency noise of a site: Allan deviation at 1 s, sqrt(h0 / 2)
OMEGA_WHITE_FM: Final = 1.2  # variance of the regression against that of the end-point slope, white FM


class Sums(NamedTuple):
    """Exact sums over the time stamps t_k, k = 0..stamps-1, of every `stride_edges`-th edge.

    Python integers of any size. `second_differences` counts the terms in `q2_ticks2`: two fewer than stamps for every
    record merged.
    """

    first_edge: int
    first_ticks: int
    stamps: int
    stride_edges: int
    span_ticks: int
    s1_ticks: int
    s2_ticks: int
    q2_ticks2: int
    second_differences: int

    @classmethod
    def of(cls, record: SingleToneRecord) -> Self:
        return cls(*record[:8], record.stamps - 2)


def continues(earlier: Sums, later: Sums) -> bool:
    """Tell whether the stamps of `later` run on from those of `earlier` without a missing or an extra one."""
    gap_ticks = (later.first_ticks - earlier.first_ticks - earlier.span_ticks) & WRAP_MASK
    return (
        later.stride_edges == earlier.stride_edges
        and (earlier.first_edge + earlier.stamps * earlier.stride_edges - later.first_edge) & WRAP_MASK == 0
        and 0 < gap_ticks * (earlier.stamps - 1) < 2 * earlier.span_ticks
    )


def merge(parts: Iterable[Sums]) -> Sums:
    """Add up adjacent parts, one or more, to the sums over all their stamps, as if one gate had taken them.

    Second differences across the seams are not in the parts and stay out of `q2_ticks2`. Counters may wrap between any
    two parts. Raises ValueError where a part does not continue the one before it.
    """
    rest = iter(parts)
    first = next(rest)
    stamps, span, s1, s2 = first.stamps, first.span_ticks, first.s1_ticks, first.s2_ticks
    q2, differences = first.q2_ticks2, first.second_differences
    previous = first
    for part in rest:
        if not continues(previous, part):
            raise ValueError(
                f"part at edge {part.first_edge} does not continue the one at edge {previous.first_edge}: "
                f"{previous.stamps} stamps, stride {previous.stride_edges}"
            )
        # Distance of the two first stamps: the gap after the last one is below a wrap, the whole need not be.
        offset = span + ((part.first_ticks - first.first_ticks - span) & WRAP_MASK)
        count = part.stamps
        s2 += part.s2_ticks + stamps * part.s1_ticks + offset * (count * (count - 1) // 2) + stamps * count * offset
        s1 += part.s1_ticks + count * offset
        span = offset + part.span_ticks
        stamps += count
        q2 += part.q2_ticks2
        differences += part.second_differences
        previous = part
    return Sums(first.first_edge, first.first_ticks, stamps, first.stride_edges, span, s1, s2, q2, differences)


def frequency_hz(sums: Sums, reference_hz: float) -> float:
    """Frequency of the edges by regression of stamp time on edge number.

    The slope is 6 (2 S2 - (N-1) S1) / (D N (N^2 - 1)) ticks per edge.
    """
    stamps = sums.stamps
    edges = sums.stride_edges * stamps * (stamps * stamps - 1)
    ticks = 6 * (2 * sums.s2_ticks - (stamps - 1) * sums.s1_ticks)
    return reference_hz * (edges / ticks)


def stamp_std_ticks(sums: Sums) -> float:
    """Noise of one stamp from its second differences, sqrt(Q2 / 6n); at least that of rounding to whole ticks."""
    return math.sqrt(max(sums.q2_ticks2 / (6 * sums.second_differences), QUANTISATION_TICKS2))


def counter_std(sums: Sums) -> float:
    """Relative standard deviation of `frequency_hz` from white noise of the stamps: sqrt(12 s^2 / (N T^2))."""
    stamps = sums.stamps
    interval_ticks = sums.span_ticks / (stamps - 1)
    return stamp_std_ticks(sums) / interval_ticks * math.sqrt(12 / (stamps * (stamps * stamps - 1)))


def oscillator_std(window_s: float) -> float:
    """Relative standard deviation of a regression over `window_s` from white frequency noise: sqrt(1.2 h0 / 2T)."""
    return OSCILLATOR_STD_1S * math.sqrt(OMEGA_WHITE_FM / window_s)


_FLAG_FAULTS: Final = (
    (RecordFlag.NO_SIGNAL, "no_signal"),
    (RecordFlag.OVERFLOW, "overflow"),
    (RecordFlag.CAPTURE_SWITCH, "capture_switch"),
    (RecordFlag.LOST_EDGE, "lost_edge"),
    (RecordFlag.SATURATED, "saturated"),
)
_UNUSABLE: Final = sum(int(flag) for flag, _ in _FLAG_FAULTS)
_STRIDE_BREAK: Final = int(RecordFlag.STRIDE_BREAK)


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


class SlidingWindow:
    """The last `frames` gates of one channel, for as long as the same tone's stamps run on without a break."""

    def __init__(self, frames: int, reference_hz: float, band_hz: tuple[float, float]) -> None:
        """`band_hz` is the lowest and the highest frequency that the plate could ever send."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        self._parts: deque[Sums] = deque(maxlen=frames)
        self._reference_hz = reference_hz
        self._lowest_hz, self._highest_hz = band_hz
        self._last_hz = math.nan
        self.fault: str | None = None

    def restart(self) -> None:
        """Forget everything, as after a gap."""
        self._parts.clear()
        self.fault = None

    def push(self, record: SingleToneRecord) -> str | None:
        """Take one gate's record; returns why it is not usable, else None.

        An unusable record empties the window; one that does not run on from the last starts it anew.
        """
        self.fault = fault(record)
        if self.fault is not None:
            self._parts.clear()
            return self.fault
        part = Sums.of(record)
        gate_hz = frequency_hz(part, self._reference_hz)
        if not self._lowest_hz <= gate_hz <= self._highest_hz:
            self._parts.clear()
            self.fault = "impossible_frequency"
            return self.fault
        if self._parts and (
            record.flags & _STRIDE_BREAK
            or abs(gate_hz - self._last_hz) > FREQUENCY_JUMP * gate_hz
            or not continues(self._parts[-1], part)
        ):
            self._parts.clear()
        self._parts.append(part)
        self._last_hz = gate_hz
        return None

    @property
    def full(self) -> bool:
        return len(self._parts) == self._parts.maxlen

    def sums(self) -> Sums | None:
        """Add up the whole window, None until it is full."""
        return merge(self._parts) if self.full else None
