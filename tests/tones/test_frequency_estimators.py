from fractions import Fraction

import numpy as np
import pytest
from brute_force_board import REFERENCE_HZ, WRAP, record_of
from hypothesis import given
from hypothesis import strategies as st

from resonator_daemon.tones.frequency_estimators import (
    LAMBDA_WHITE_FM,
    OMEGA_WHITE_FM,
    PI_WHITE_FM,
    Sums,
    continues,
    counter_std,
    frequency_hz,
    lambda_counter_std,
    lambda_frequency_hz,
    merge,
    oscillator_std,
    pi_counter_std,
    pi_frequency_hz,
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
    merged, whole = merge(parts), sums_of(ticks, first_edge, stride)
    assert merged[:7] == whole[:7]
    assert merged.q2_ticks2 == sum(part.q2_ticks2 for part in parts)
    assert merged.second_differences == sum(lengths) - 2 * len(lengths)


@pytest.mark.parametrize(
    "change",
    [
        {"first_edge": 1000 + 1},
        {"first_edge": 1000 - 10},
        {"first_edge": 1000 + (1 << 20)},
        {"stride_edges": 11},
        {"first_ticks": 100 * 1000 - 1000},  # the last stamp again
        {"first_ticks": 102 * 1000},
        {"first_ticks": 100 * 1000 - 5000},
    ],
)
def test_parts_that_do_not_run_on_are_not_merged(change):
    ticks = [1000 * k for k in range(200)]
    earlier, later = split(ticks, [100, 100], 0, 10)
    assert continues(earlier, later)
    assert not continues(earlier, later._replace(**change))
    with pytest.raises(ValueError, match="does not continue"):
        merge([earlier, later._replace(**change)])


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


@given(steps=st.lists(st.integers(90, 110), min_size=4, max_size=40), stride=st.integers(1, 1000), data=st.data())
def test_end_points_and_two_means_of_stamps(steps, stride, data):
    ticks = [int(t) for t in np.cumsum(steps)]
    at = data.draw(st.integers(2, len(ticks) - 2))
    halves = split(ticks, [at, len(ticks) - at], 7, stride)
    pi = Fraction((len(ticks) - 1) * stride, ticks[-1] - ticks[0]) * 10**9
    assert pi_frequency_hz(merge(halves), REFERENCE_HZ) == pytest.approx(float(pi), rel=4e-16)
    edges = [stride * k for k in range(len(ticks))]
    mean = [(Fraction(sum(x[:at]), at), Fraction(sum(x[at:]), len(ticks) - at)) for x in (edges, ticks)]
    two_means = (mean[0][1] - mean[0][0]) / (mean[1][1] - mean[1][0]) * 10**9
    assert lambda_frequency_hz(halves, REFERENCE_HZ) == pytest.approx(float(two_means), rel=4e-16)


def test_stated_noise_of_each_estimator_is_its_spread_and_stands_in_the_known_ratio():
    rng = np.random.default_rng(12)
    stamps, found, stated = 100, [], []
    for _ in range(2500):
        halves = split(jittered(rng, stamps, 1.0), [stamps // 2] * 2, 0, 10)
        whole = merge(halves)
        estimates = pi_frequency_hz(whole, 1.0), lambda_frequency_hz(halves, 1.0), frequency_hz(whole, 1.0)
        found.append(estimates)
        stated.append((pi_counter_std(whole), lambda_counter_std(whole), counter_std(whole)))
    stated = np.sqrt(np.mean(np.square(stated), axis=0))
    np.testing.assert_allclose(np.std(found, axis=0) / np.mean(found), stated, rtol=0.05)
    # Variances of s^2 / T^2, T from the first stamp to the last or to the one after.
    np.testing.assert_allclose((stated / stated[2]) ** 2 * 12 / stamps, [2, 16 / stamps, 12 / stamps], rtol=0.03)


def test_oscillator_noise_of_each_estimator_under_white_frequency_noise():
    rng = np.random.default_rng(8)
    steps, window_s = 400, 0.01
    # Allan deviation 3e-10 at 1 s: the mean frequency over tau has the variance (3e-10)^2 / tau.
    dy = rng.normal(0, 3e-10 / np.sqrt(window_s / steps), (8000, steps))
    phase_s = np.cumsum(dy, axis=1) * window_s / steps
    omega = np.polyfit(np.arange(1, steps + 1) * window_s / steps, phase_s.T, 1)[0]
    halves = phase_s.reshape(-1, 2, steps // 2).mean(axis=2)
    two_means = (halves[:, 1] - halves[:, 0]) / (window_s / 2)
    pi = dy.mean(axis=1)
    for slopes, white_fm in ((pi, PI_WHITE_FM), (two_means, LAMBDA_WHITE_FM), (omega, OMEGA_WHITE_FM)):
        assert slopes.std() == pytest.approx(oscillator_std(window_s, white_fm), rel=0.02)
    assert oscillator_std(window_s) == pytest.approx(omega.std(), rel=0.02)
    assert oscillator_std(0.01) == pytest.approx(3.29e-9, rel=0.01)


@pytest.mark.parametrize("span_bits", [32, 40, 63, 80])
def test_a_line_of_any_length_keeps_its_frequency_exactly(span_bits):
    interval, stamps, first = 123_456_789, 16, (1 << span_bits) - 5
    ticks = [first + k * interval for k in range(stamps)]
    sums = sums_of(ticks, WRAP - 3, 977)
    while sums.span_ticks < 1 << span_bits:
        distance = sums.stamps * interval
        edge = (sums.first_edge + sums.stamps * 977) % WRAP
        sums = merge([sums, sums._replace(first_edge=edge, first_ticks=(sums.first_ticks + distance) % WRAP)])
    count = sums.stamps
    assert sums.span_ticks == (count - 1) * interval
    assert sums.s1_ticks == interval * count * (count - 1) // 2
    assert sums.s2_ticks == interval * count * (count - 1) * (2 * count - 1) // 6
    halves = [
        sums,
        sums._replace(
            first_edge=(sums.first_edge + count * 977) % WRAP, first_ticks=(sums.first_ticks + count * interval) % WRAP
        ),
    ]
    assert frequency_hz(sums, REFERENCE_HZ) == pi_frequency_hz(sums, REFERENCE_HZ) == REFERENCE_HZ * (977 / interval)
    assert lambda_frequency_hz(halves, REFERENCE_HZ) == REFERENCE_HZ * (977 / interval)


@pytest.mark.parametrize("interval", [1 << 28, 1 << 30, (1 << 32) - 1])
def test_stamps_may_lie_as_far_apart_as_the_counter_tells(interval):
    ticks = [WRAP - 5 + k * interval for k in range(12)]
    assert merge(split(ticks, [4] * 3, 0, 10))[:7] == sums_of(ticks, 0, 10)[:7]
