"""Frequency from a counter's exact integer sums: merging adjacent gates, a regression, and its noise.

Integers stay exact until the one division that makes a frequency. Definitions of the sums are in
`firmware_protocol.layouts`. Relative variances over a window T of N stamps, each off by s, and of an oscillator whose
white frequency noise has the density h0 (Rubiola et al., The Omega counter, 2016; Dawkins et al., Considerations on the
measurement of the stability of oscillators with frequency counters, 2007):

| estimator | | white noise of stamps | white frequency noise |
| --- | --- | --- | --- |
| Pi | end points | 2 s^2 / T^2 | h0 / 2T: optimal |
| Lambda | means of two halves | 16 s^2 / (N T^2) | 4/3 h0 / 2T |
| Omega | regression | 12 s^2 / (N T^2): optimal, the Cramer-Rao bound | 6/5 h0 / 2T |

Omega, the one computed here, is the one for a window of one reading, and never much worse than the best. Means of
frequencies are none of these: they throw away what joins the gates.
"""

import math
from collections.abc import Iterable
from typing import Final, NamedTuple, Self

from firmware_protocol.layouts import SingleToneRecord

WRAP_MASK: Final = 0xFFFFFFFF  # edge and tick counters are 32 bits wide on the wire
FREQUENCY_JUMP: Final = 20e-6  # between adjacent gates; a press of 3 N/ms at 6.3e-6 / N stays below it
QUANTISATION_TICKS2: Final = 1 / 12  # variance of a stamp rounded to whole ticks
OSCILLATOR_STD_1S: Final = 3e-10  # usual white frequency noise of a site: Allan deviation at 1 s, sqrt(h0 / 2)
OMEGA_WHITE_FM: Final = 1.2  # variance of a regression from white frequency noise over that of the end-point slope


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


PlainSums = tuple[int, int, int, int, int, int, int, int, int]
"""The fields of `Sums` without its class: made in half the time, thousands a second."""


def merge_adjacent(parts: Iterable[PlainSums]) -> Sums:
    """Add up parts that are known to be adjacent to the sums over all their stamps, as if one gate had taken them.

    Second differences across the seams are not in the parts and stay out of `q2_ticks2`. Counters may wrap between any
    two parts.
    """
    rest = iter(parts)
    first_edge, first_ticks, stamps, stride_edges, span, s1, s2, q2, differences = next(rest)
    for _, part_ticks, count, _, part_span, part_s1, part_s2, part_q2, part_differences in rest:
        # Distance of the two first stamps: the gap after the last one is below a wrap, the whole need not be.
        offset = span + ((part_ticks - first_ticks - span) & WRAP_MASK)
        shift = count * offset
        s2 += part_s2 + stamps * (part_s1 + shift) + (count - 1) * shift // 2
        s1 += part_s1 + shift
        span = offset + part_span
        stamps += count
        q2 += part_q2
        differences += part_differences
    return Sums(first_edge, first_ticks, stamps, stride_edges, span, s1, s2, q2, differences)


def frequency_hz(sums: Sums, reference_hz: float) -> float:
    """Frequency of the edges by regression of stamp time on edge number (Omega).

    The slope is 6 (2 S2 - (N-1) S1) / (D N (N^2 - 1)) ticks per edge.
    """
    stamps = sums.stamps
    edges = sums.stride_edges * stamps * (stamps * stamps - 1)
    ticks = 6 * (2 * sums.s2_ticks - (stamps - 1) * sums.s1_ticks)
    return reference_hz * (float(edges) / float(ticks))  # as arrays of doubles would have it


def stamp_std_ticks(sums: Sums) -> float:
    """Noise of one stamp from its second differences, sqrt(Q2 / 6n); at least that of rounding to whole ticks."""
    return math.sqrt(max(sums.q2_ticks2 / (6 * sums.second_differences), QUANTISATION_TICKS2))


def counter_std(sums: Sums) -> float:
    """Relative standard deviation of `frequency_hz` from white noise of the stamps: sqrt(12 s^2 / (N T^2))."""
    return regression_std(stamp_std_ticks(sums), sums.stamps, sums.span_ticks)


def regression_std(stamp_ticks: float, stamps: int, span_ticks: int) -> float:
    """Return sqrt(12 s^2 / (N T^2)), of `counter_std`, for stamps that are off by `stamp_ticks`."""
    return stamp_ticks * (stamps - 1) / span_ticks * math.sqrt(12 / (stamps * (stamps * stamps - 1)))


def oscillator_std(window_s: float, std_1s: float = OSCILLATOR_STD_1S) -> float:
    """Relative standard deviation of `frequency_hz` over `window_s` from white frequency noise, sqrt(c h0 / 2T)."""
    return std_1s * math.sqrt(OMEGA_WHITE_FM / window_s)
