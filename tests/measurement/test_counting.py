from fractions import Fraction

import numpy as np
import pytest
from brute_force_board import REFERENCE_HZ, WRAP, Channel, record_of
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.measurement.counting import (
    SlidingWindow,
    Sums,
    continues,
    counter_std,
    fault,
    frequency_hz,
    merge,
    oscillator_std,
    stamp_std_ticks,
)

BAND_HZ = (9e6, 11e6)


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


@pytest.mark.parametrize("start", [WRAP - 5_500_000, WRAP - 1, 123])
def test_ten_gates_of_1_ms_merge_to_one_of_10_ms_across_both_wraps(start):
    rng = np.random.default_rng(3)
    channel = Channel(rng, 10, WRAP - 55_555, start)
    frames = [Sums.of(channel.gate(9.9876e6, start + (k + 1) * 1_000_000)) for k in range(10)]
    rng = np.random.default_rng(3)
    whole = Sums.of(Channel(rng, 10, WRAP - 55_555, start).gate(9.9876e6, start + 10_000_000))
    merged = merge(frames)
    # Both draw the same jitter one after another, so that the stamps are the same.
    assert merged[:7] == whole[:7]
    assert merge([merge(frames[:4]), merge(frames[4:])]) == merged


def test_a_merge_may_span_more_ticks_than_the_counter_holds():
    interval, stamps = 100_000_000, 20
    ticks = [7 + k * interval for k in range(5 * stamps)]  # 10^10 ticks, more than two wraps
    merged = merge(split(ticks, [stamps] * 5, 11, 10))
    assert merged.span_ticks == 99 * interval > 2 * WRAP
    assert merged[:7] == sums_of(ticks, 11, 10)[:7]
    assert frequency_hz(merged, REFERENCE_HZ) == 100.0


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


def test_frequency_of_exact_stamps_is_exact():
    assert frequency_hz(sums_of(range(0, 1_000_000, 1000)), REFERENCE_HZ) == 10e6


def jittered(rng, stamps, jitter_ticks, interval=1000.37):
    times = interval * np.arange(stamps) + rng.normal(0, jitter_ticks, stamps) + rng.random()
    return np.floor(times).astype(np.int64).tolist()


def test_stamp_noise_from_second_differences():
    sums = sums_of(jittered(np.random.default_rng(5), 20_000, 0.6))
    assert stamp_std_ticks(sums) == pytest.approx(np.sqrt(0.6**2 + 1 / 12), rel=0.02)


def test_stamp_noise_is_never_below_rounding():
    assert stamp_std_ticks(sums_of(range(0, 100_000, 1000))) == pytest.approx(1 / np.sqrt(12))


@pytest.mark.parametrize("stamps", [20, 1000])
def test_stated_counter_noise_is_the_spread_of_frequencies(stamps):
    rng = np.random.default_rng(6)
    readings = [sums_of(jittered(rng, stamps, 1.0)) for _ in range(600)]
    frequencies = np.array([frequency_hz(reading, REFERENCE_HZ) for reading in readings])
    stated = np.sqrt(np.mean([counter_std(reading) ** 2 for reading in readings]))
    assert frequencies.std() / frequencies.mean() == pytest.approx(stated, rel=0.08)
    assert stated == pytest.approx(np.sqrt(12 * (1 + 1 / 12) / stamps) / (stamps * 1000.37), rel=0.03)


def test_merging_ten_gates_is_ten_times_better_than_their_mean():
    rng = np.random.default_rng(7)
    merged, mean = [], []
    for _ in range(300):
        parts = split(jittered(rng, 1000, 1.0), [100] * 10, 0, 10)
        merged.append(frequency_hz(merge(parts), REFERENCE_HZ))
        mean.append(np.mean([frequency_hz(part, REFERENCE_HZ) for part in parts]))
    assert np.std(mean) / np.std(merged) == pytest.approx(10, rel=0.15)


def test_oscillator_noise_of_a_regression_under_white_frequency_noise():
    rng = np.random.default_rng(8)
    steps, window_s = 400, 0.01
    # Allan deviation 3e-10 at 1 s: the mean frequency over tau has the variance (3e-10)^2 / tau.
    dy = rng.normal(0, 3e-10 / np.sqrt(window_s / steps), (4000, steps))
    phase_s = np.cumsum(dy, axis=1) * window_s / steps
    slopes = np.polyfit(np.arange(1, steps + 1) * window_s / steps, phase_s.T, 1)[0]
    assert slopes.std() == pytest.approx(oscillator_std(window_s), rel=0.04)
    assert oscillator_std(0.01) == pytest.approx(3.29e-9, rel=0.01)


GOOD = record_of([1000 * k for k in range(1000)], 0, 10)


def test_a_steady_tone_has_no_fault():
    assert fault(GOOD) is None
    assert fault(GOOD._replace(flags=int(RecordFlag.STRIDE_BREAK))) is None
    assert fault(record_of([0, 1000, 2001], 0, 10)) is None


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"flags": RecordFlag.NO_SIGNAL}, "no_signal"),
        ({"flags": RecordFlag.OVERFLOW}, "overflow"),
        ({"flags": RecordFlag.CAPTURE_SWITCH | RecordFlag.STRIDE_BREAK}, "capture_switch"),
        ({"flags": RecordFlag.LOST_EDGE}, "lost_edge"),
        ({"flags": RecordFlag.SATURATED}, "saturated"),
        ({"stamps": 0}, "impossible_counts"),
        ({"stamps": 1}, "impossible_counts"),
        ({"stamps": 2, "span_ticks": 1000, "s1_ticks": 1000, "s2_ticks": 1000}, "impossible_counts"),
        ({"stride_edges": 0}, "impossible_counts"),
        ({"span_ticks": 0}, "impossible_counts"),
        ({"span_ticks": 0, "s1_ticks": 0, "s2_ticks": 0}, "impossible_counts"),
        ({"span_ticks": 998}, "impossible_counts"),
        ({"s1_ticks": 0}, "impossible_counts"),
        ({"s1_ticks": GOOD.s1_ticks + (1 << 25)}, "impossible_counts"),
        ({"s1_ticks": (1 << 64) - 1}, "impossible_counts"),
        ({"s2_ticks": 0}, "impossible_counts"),
        ({"s2_ticks": GOOD.s2_ticks - (1 << 34)}, "impossible_counts"),
        ({"s2_ticks": (1 << 64) - 1}, "impossible_counts"),
    ],
)
def test_impossible_records_are_named(change, cause):
    assert fault(GOOD._replace(**change)) == cause


def window(frames=3):
    return SlidingWindow(frames, REFERENCE_HZ, BAND_HZ)


def frames_of(frequencies_hz, flags=None):
    channel = Channel(np.random.default_rng(9), 10, 0, 0)
    flags = flags or {}
    return [channel.gate(f, (k + 1) * 1_000_000, int(flags.get(k, 0))) for k, f in enumerate(frequencies_hz)]


def test_a_window_gives_the_merged_sums_of_its_last_gates():
    slide, frames = window(), frames_of([10e6] * 5)
    seen = []
    for frame in frames:
        assert slide.push(frame) is None
        seen.append(slide.sums())
    assert seen[:2] == [None, None]
    assert seen[2:] == [merge([Sums.of(frame) for frame in frames[k - 2 : k + 1]]) for k in (2, 3, 4)]


def full_after(slide, frames):
    return [slide.push(frame) or ("full" if slide.sums() else "filling") for frame in frames]


def test_a_flagged_gate_empties_the_window_and_the_next_starts_anew():
    flags = {3: RecordFlag.CAPTURE_SWITCH}
    told = full_after(window(), frames_of([10e6] * 8, flags))
    assert told == ["filling"] * 2 + ["full", "capture_switch"] + ["filling"] * 2 + ["full"] * 2


def test_a_stride_break_starts_the_window_anew_with_that_gate():
    told = full_after(window(), frames_of([10e6] * 7, {3: RecordFlag.STRIDE_BREAK}))
    assert told == ["filling"] * 2 + ["full"] + ["filling"] * 2 + ["full"] * 2


def test_a_missing_gate_starts_the_window_anew():
    frames = frames_of([10e6] * 8)
    del frames[3]
    assert full_after(window(), frames) == ["filling"] * 2 + ["full"] + ["filling"] * 2 + ["full"] * 2


@pytest.mark.parametrize(("jump", "restarts"), [(15e-6, False), (-15e-6, False), (25e-6, True), (-25e-6, True)])
def test_a_capture_switch_that_the_board_does_not_flag_starts_the_window_anew(jump, restarts):
    told = full_after(window(), frames_of([10e6] * 4 + [10e6 * (1 + jump)] * 3))
    after = ["filling"] * 2 + ["full"] if restarts else ["full"] * 3
    assert told == ["filling"] * 2 + ["full"] * 2 + after


@pytest.mark.parametrize("frequency", [8.9e6, 11.1e6])
def test_a_frequency_outside_the_band_is_a_fault(frequency):
    slide = window()
    assert slide.push(frames_of([frequency])[0]) == "impossible_frequency"
    assert slide.fault == "impossible_frequency"
    assert slide.sums() is None


def test_restart_forgets_gates_and_fault():
    slide = window(1)
    slide.push(frames_of([10e6])[0])
    assert slide.full
    slide.restart()
    assert not slide.full
    slide.push(SingleToneRecord(*[0] * 10))
    slide.restart()
    assert slide.fault is None


def test_a_window_of_no_gates_is_refused():
    with pytest.raises(ValueError, match="0 frames"):
        window(0)


def test_sums_that_contradict_each_other_give_no_frequency() -> None:
    """A regression slope that leaves the end points' behind is damage that a check sum cannot see."""
    stamps = [1000 + 1001 * k // 10 * 10 for k in range(1000)]
    offsets = [stamp - stamps[0] for stamp in stamps]
    second = [offsets[k] - 2 * offsets[k - 1] + offsets[k - 2] for k in range(2, 1000)]
    s2 = sum(k * offset for k, offset in enumerate(offsets))
    sound = SingleToneRecord(
        0, 1000, 1000, 10, offsets[-1], sum(offsets), s2, sum(value * value for value in second), 0, 0
    )
    assert fault(sound) is None
    assert fault(sound._replace(s2_ticks=s2 + s2 // 20_000)) == "impossible_counts"
    assert fault(sound._replace(s2_ticks=s2 - s2 // 20_000)) == "impossible_counts"
    assert fault(sound._replace(q2_ticks2=2**64 - 1)) == "impossible_counts"


def test_a_slope_of_nothing_is_no_frequency() -> None:
    assert fault(SingleToneRecord(0, 0, 3, 1, 2, 3, 3, 0, 0, 0)) == "impossible_counts"
