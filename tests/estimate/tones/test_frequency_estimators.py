from fractions import Fraction

import numpy as np
import pytest
from brute_force_board import REFERENCE_HZ, WRAP, record_of
from hypothesis import given
from hypothesis import strategies as st

from resonator_daemon.estimate.tones.frequency_estimators import (
    Sums,
    counter_std,
    frequency_hz,
    merge_adjacent,
    oscillator_std,
)


def sums_of(ticks, first_edge=0, stride=10):
    return Sums.of(record_of(ticks, first_edge, stride))


def split(ticks, lengths, first_edge, stride):
    parts, start = [], 0
    for length in lengths:
        parts.append(sums_of(ticks[start : start + length], first_edge + start * stride, stride))
        start += length
    return parts


@given(
    lengths=st.lists(st.integers(3, 9), min_size=1, max_size=8),
    interval=st.integers(40, 100_000),
    first_edge=st.integers(0, WRAP - 1),
    first_ticks=st.integers(0, WRAP - 1),
    stride=st.integers(1, 65_535),
    seed=st.integers(0, 2**32 - 1),
)
def test_merged_parts_equal_one_long_gate_exactly(lengths, interval, first_edge, first_ticks, stride, seed):
    steps = interval + np.random.default_rng(seed).integers(-interval // 8, interval // 8 + 1, sum(lengths))
    ticks = [first_ticks + int(t) for t in np.cumsum(steps)]
    parts = split(ticks, lengths, first_edge, stride)
    merged, whole = merge_adjacent(parts), sums_of(ticks, first_edge, stride)
    assert merged[:7] == whole[:7]
    assert merged.q2_ticks2 == sum(part.q2_ticks2 for part in parts)
    assert merged.second_differences == sum(lengths) - 2 * len(lengths)


@given(steps=st.lists(st.integers(90, 110), min_size=3, max_size=40), stride=st.integers(1, 1000))
def test_frequency_is_that_of_a_least_squares_line(steps, stride):
    ticks = [int(t) for t in np.cumsum(steps)]
    edges = [Fraction(k * stride) for k in range(len(ticks))]
    mean_edge, mean_tick = sum(edges) / len(edges), Fraction(sum(ticks), len(ticks))
    slope = sum((n - mean_edge) * (t - mean_tick) for n, t in zip(edges, ticks, strict=True)) / sum(
        (n - mean_edge) ** 2 for n in edges
    )
    assert frequency_hz(sums_of(ticks, 0, stride), REFERENCE_HZ) == pytest.approx(float(10**9 / slope), rel=4e-16)


def jittered(rng, stamps, jitter_ticks, interval=1000.37):
    times = interval * np.arange(stamps) + rng.normal(0, jitter_ticks, stamps) + rng.random()
    return np.floor(times).astype(np.int64).tolist()


def test_stated_noise_is_the_spread():
    rng = np.random.default_rng(12)
    gates = [sums_of(jittered(rng, 100, 1.0)) for _ in range(2500)]
    found = [frequency_hz(sums, 1.0) for sums in gates]
    stated = np.sqrt(np.mean(np.square([counter_std(sums) for sums in gates])))
    assert np.std(found) / np.mean(found) == pytest.approx(stated, rel=0.05)
    # 12 s^2 / (N T^2), T from the first stamp to the last or to the one after.
    assert stated**2 == pytest.approx(12 * (1 + 1 / 12) / 100 / (100 * 1000.37) ** 2, rel=0.03)


def test_oscillator_noise_under_white_frequency_noise():
    rng = np.random.default_rng(8)
    steps, window_s = 400, 0.01
    # Allan deviation 3e-10 at 1 s: the mean frequency over tau has the variance (3e-10)^2 / tau.
    dy = rng.normal(0, 3e-10 / np.sqrt(window_s / steps), (8000, steps))
    phase_s = np.cumsum(dy, axis=1) * window_s / steps
    slopes = np.polyfit(np.arange(1, steps + 1) * window_s / steps, phase_s.T, 1)[0]
    assert oscillator_std(window_s) == pytest.approx(slopes.std(), rel=0.02)
    assert oscillator_std(0.01) == pytest.approx(3.29e-9, rel=0.01)


@pytest.mark.parametrize("span_bits", [32, 40, 63, 80])
def test_a_line_of_any_length_keeps_its_frequency_exactly(span_bits):
    interval, stamps, first = 123_456_789, 16, (1 << span_bits) - 5
    ticks = [first + k * interval for k in range(stamps)]
    sums = sums_of(ticks, WRAP - 3, 977)
    while sums.span_ticks < 1 << span_bits:
        distance = sums.stamps * interval
        edge = (sums.first_edge + sums.stamps * 977) % WRAP
        sums = merge_adjacent([sums, sums._replace(first_edge=edge, first_ticks=(sums.first_ticks + distance) % WRAP)])
    count = sums.stamps
    assert sums.span_ticks == (count - 1) * interval
    assert sums.s1_ticks == interval * count * (count - 1) // 2
    assert sums.s2_ticks == interval * count * (count - 1) * (2 * count - 1) // 6
    assert frequency_hz(sums, REFERENCE_HZ) == REFERENCE_HZ * (977 / interval)


@pytest.mark.parametrize("interval", [1 << 28, 1 << 30, (1 << 32) - 1])
def test_stamps_may_lie_as_far_apart_as_the_counter_tells(interval):
    ticks = [WRAP - 5 + k * interval for k in range(12)]
    assert merge_adjacent(split(ticks, [4] * 3, 0, 10))[:7] == sums_of(ticks, 0, 10)[:7]
