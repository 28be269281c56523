"""Errors of a counted tone: beats of stamps with the reference, and tones besides it, against stamps written out."""

import math

import numpy as np
import pytest
from brute_force_board import record_of

from resonator_daemon.estimate.tones.frequency_estimators import Sums, frequency_hz
from resonator_daemon.estimate.tones.record_checks import read_gates
from resonator_daemon.estimate.tones.tone_count import (
    EXCESS_LIMIT,
    RESIDUAL_LIMIT,
    count_tone,
    excess_bound,
    has_other_tone,
    pilot_beat_std_hz,
    pilot_residual_ticks2,
    stamp_jitter_ticks,
)


def stamped(rng, interval, jitter, stamps, windows):
    """Whole ticks of stamps (windows, stamps), first at any phase of a tick."""
    times = interval * np.arange(stamps) + rng.random((windows, 1))
    return np.floor(times + (rng.normal(0, jitter, times.shape) if jitter else 0.0))


def slopes(ticks):
    """Ticks per stamp by regression."""
    lever = np.arange(ticks.shape[1]) - (ticks.shape[1] - 1) / 2
    return (ticks - ticks[:, :1]) @ lever / (lever @ lever)


def white_variance(jitter, stamps):
    """Cramer-Rao bound of the slope under white noise of the jitter's and a rounded tick's variance."""
    return 12 * (jitter**2 + 1 / 12) / (stamps * (stamps**2 - 1))


def records(ticks):
    return [Sums.of(record_of(row.astype(np.int64).tolist(), 0, 10)) for row in ticks]


def beats(interval, jitter, stamps):
    return excess_bound(interval, jitter, stamps) > EXCESS_LIMIT


def line_by_line(interval, jitter, stamps):
    """Excess by the envelope of the regression's response to each line, as Widrow and Kollar give their powers."""
    harmonic = np.arange(1, 2000)
    turns = harmonic * interval
    off = np.maximum(np.abs(turns - np.rint(turns)), 0.7874 / stamps)
    powers = np.exp(-((2 * np.pi * harmonic * jitter) ** 2)) / (2 * (np.pi * harmonic) ** 2)
    cotangent2, sine2 = 1 / np.tan(np.pi * off) ** 2, np.sin(np.pi * off) ** 2
    gain = 3 * (cotangent2 + stamps**2) / sine2 / (stamps * (stamps**2 - 1))
    return powers @ (gain - 1) / (jitter**2 + 1 / 12)


@pytest.mark.parametrize("jitter", [0.05, 0.074, 0.076, 0.2, 0.29, 0.31, 0.6, 0.7])
@pytest.mark.parametrize("stamps", [3, 99, 1000])
def test_the_bound_adds_up_all_lines_that_count(jitter, stamps):
    # On either side of where lines are added up one by one, slow lines and quick ones, many harmonics and a single one.
    for interval in (1000.0, 1000.0003, 999.5, 1000.3334, 1234.5678):
        expected = line_by_line(interval, jitter, stamps)
        assert excess_bound(interval, jitter, stamps) == pytest.approx(expected, rel=2e-3, abs=5e-3)


@pytest.mark.parametrize(
    ("interval", "jitter", "stamps"),
    [(1000 + 6.6e-4, 0.3, 1000), (1000 + 6.6e-4, 0.0, 1000), (1000.5 + 1.7e-4, 0.1, 2000)],
)
def test_the_bound_is_the_variance_where_the_slowest_line_is_worst(interval, jitter, stamps):
    # 0.66 turns of line q over the window: 2 x / N of the response's maximum, x = 2.0816.
    windows = 3000
    found = slopes(stamped(np.random.default_rng(1), interval, jitter, stamps, windows))
    ratio = np.mean((found - interval) ** 2) / white_variance(jitter, stamps)
    assert ratio == pytest.approx(1 + excess_bound(interval, jitter, stamps), rel=0.12)


def test_the_worst_line_is_0_57_n_times_white_noise_of_its_power():
    # max of 3 j1(x)^2 is 0.5704, by the table of spherical Bessel functions: j1(2.0816) = 0.4362.
    stamps, jitter = 10_000, 0.3
    line = np.exp(-((2 * np.pi * jitter) ** 2)) / (2 * np.pi**2)
    worst = line * 0.5704 * stamps / (jitter**2 + 1 / 12)
    assert excess_bound(1000.0, jitter, stamps) == pytest.approx(worst, rel=2e-3)


def test_half_a_tick_of_jitter_is_enough_for_ten_thousand_stamps_and_0_7_for_a_million():
    near = (1000 + np.geomspace(1e-9, 1e-2, 400)).tolist()
    cases = ((0.55, 10**4, False), (0.35, 10**4, True), (0.70, 10**6, False), (0.5, 10**6, True))
    for jitter, stamps, any_beats in cases:
        assert any(beats(interval, jitter, stamps) for interval in near) is any_beats


def test_second_differences_do_not_see_a_slow_beat():
    rng = np.random.default_rng(3)
    interval, stamps = 1000 + 6e-4, 1000
    ticks = stamped(rng, interval, 0.0, stamps, 400)
    assert np.mean((slopes(ticks) - interval) ** 2) > 100 * white_variance(0.0, stamps)
    parts = records(ticks)
    assert max(part.q2_ticks2 / (6 * part.second_differences) for part in parts) < 0.02 / 12
    assert all(beats(s, stamp_jitter_ticks(p), stamps) for s, p in zip(slopes(ticks), parts, strict=True))


@pytest.mark.parametrize("part", [1e-3, 0.25, 1 / 3, 0.37, 0.48, 0.5])
@pytest.mark.parametrize("jitter", [0.0, 0.1, 0.25, 0.4, 0.7])
def test_jitter_from_second_differences_is_rather_too_small(part, jitter):
    (sums,) = records(stamped(np.random.default_rng(5), 1000 + part + 1e-5, jitter, 20_000, 1))
    found = stamp_jitter_ticks(sums)
    assert found <= np.sqrt(jitter**2 + 0.004)
    if jitter >= 0.4:
        assert found == pytest.approx(jitter, rel=0.05)


def drawn_near_ratios(rng, cases):
    """Intervals at log-uniform distances from p/q with q up to 6, with jitter from none to what hides most beats."""
    for _ in range(cases):
        stamps = int(rng.choice([100, 200, 500]))
        q = int(rng.integers(1, 7))
        distance = rng.choice([-1, 1]) * 10 ** rng.uniform(-1, 1.5) / stamps / q
        yield 1000 + rng.integers(0, q) / q + distance, rng.uniform(0.0, 0.5), stamps


def test_the_flag_misses_few_beats_and_raises_few_false_alarms():
    rng = np.random.default_rng(6)
    windows, looked_at = 600, 4
    margin = 3 * np.sqrt(2 / windows)
    beating, still = [], []
    for interval, jitter, stamps in drawn_near_ratios(rng, 260):
        ticks = stamped(rng, interval, jitter, stamps, windows)
        measured = slopes(ticks)
        excess = np.mean((measured - interval) ** 2) / white_variance(jitter, stamps) - 1
        found = [stamp_jitter_ticks(part) for part in records(ticks[:looked_at])]
        flags = [
            sum(beats(*each, stamps) for each in zip(measured, jitters, strict=False))
            for jitters in ([jitter] * looked_at, found)
        ]
        if excess > EXCESS_LIMIT + margin * (1 + excess):
            beating.append(flags)
        elif abs(excess) < EXCESS_LIMIT + margin:
            still.append(flags)
    assert min(len(beating), len(still)) > 40
    # With the jitter told, and with the jitter from the record.
    told, from_records = np.sum(beating, axis=0) / (looked_at * len(beating))
    assert told >= 0.99
    assert from_records >= 0.98
    told, from_records = np.sum(still, axis=0) / (looked_at * len(still))
    # Where an interval lies closer to p/q than the window resolves, the worst of what it may be is taken for it.
    assert told <= 0.25
    assert from_records <= 0.5


REFERENCE_HZ = 1e9
TONE_HZ = 10e6
STRIDE_EDGES = 100
STAMPS = 100
NOISE_TICKS2 = 0.6**2 + 1 / 12  # of stamps, quantisation included


def gates(rng, count, *, ratio=0.0, distance_hz=4000.0, noise_ticks=0.6):
    """Stamps (count, n) of edges of a tone and a weaker one `distance_hz` off: zero crossings found one by one."""
    edges = STRIDE_EDGES * np.arange(count * STAMPS)
    time_s = edges / TONE_HZ
    for _ in range(30):
        # The phase of cos(a) + r cos(a + b) is ahead of a by the angle of 1 + r exp(i b).
        beat = 2.0 * np.pi * distance_hz * time_s + 1.0
        time_s = (edges - np.angle(1.0 + ratio * np.exp(1j * beat)) / (2.0 * np.pi)) / TONE_HZ
    ticks = np.floor(time_s * REFERENCE_HZ + rng.normal(0.0, noise_ticks, time_s.shape) + 1e6).astype(np.int64)
    return ticks.reshape(count, STAMPS)


def end_residual_ticks2(ticks):
    ((_, _, residual_ticks2),) = read_gates([record_of(ticks.tolist(), 0, STRIDE_EDGES)], REFERENCE_HZ, (9e6, 11e6))
    return residual_ticks2


@pytest.mark.parametrize("ratio", [0.1, 0.2, 0.4])
def test_a_second_tone_moves_edges_by_the_share_of_a_period_that_its_ratio_says(ratio):
    whole_beats = gates(np.random.default_rng(1), 200, ratio=ratio, distance_hz=4000.0)
    on_a_line = np.arange(whole_beats.size) * STRIDE_EDGES / TONE_HZ * REFERENCE_HZ + 1e6
    moved = whole_beats.ravel() + 0.5 - on_a_line
    predicted = pilot_residual_ticks2(ratio, TONE_HZ, REFERENCE_HZ)
    # The angle of 1 + r exp(i b) has the mean square sum r^(2n) / (2 n^2): more than its first term by r^2 / 4.
    assert np.mean(moved**2) - NOISE_TICKS2 == pytest.approx(predicted, rel=0.08)


@pytest.mark.parametrize("distance_hz", [3650.0, 4000.0, 17_300.0])
def test_a_second_tone_of_three_tenths_is_heard_at_any_distance(distance_hz):
    # Beats in step with the gates show the same phase at every end: no difference of gates shows them.
    rng = np.random.default_rng(3)

    def windows_heard(ratio):
        left = [end_residual_ticks2(t) for t in gates(rng, 1000, ratio=ratio, distance_hz=distance_hz)]
        windows = np.reshape(left, (100, 10)).mean(axis=1)
        return sum(has_other_tone(window, NOISE_TICKS2, 0.0) for window in windows.tolist())

    assert windows_heard(0.3) > 95
    assert windows_heard(0.0) == 0


def test_a_pilot_that_is_known_is_no_other_tone():
    assert has_other_tone(10.0, 0.5, 0.0)
    assert not has_other_tone(10.0, 0.5, 1.0)
    assert not has_other_tone(math.nan, 0.5, 0.0)
    assert not has_other_tone(RESIDUAL_LIMIT * 1.4, 0.5, 1.0)


@pytest.mark.parametrize("count", [2, 10])
@pytest.mark.parametrize("pilot_db", [-6.0, -15.0, -35.0])
@pytest.mark.parametrize("distance_hz", [2011.0, 4013.0, 100_061.0])  # the last seems slow to the stamps
def test_the_noise_of_a_window_contains_the_beat_with_the_pilot(count, pilot_db, distance_hz):
    ticks = gates(np.random.default_rng(5), 100 * count, ratio=10.0 ** (pilot_db / 20.0), distance_hz=distance_hz)
    windows = [Sums.of(record_of(window.tolist(), 0, STRIDE_EDGES)) for window in ticks.reshape(100, -1)]
    found_hz = [frequency_hz(sums, REFERENCE_HZ) for sums in windows]
    known = {"reference_hz": REFERENCE_HZ, "pilot_hz": TONE_HZ + distance_hz, "over_pilot_db": pilot_db}
    window_s = count * STAMPS * STRIDE_EDGES / TONE_HZ
    stated = [
        count_tone(sums, hertz, 0.0, **known, distance_hz=distance_hz, window_s=window_s).std
        for sums, hertz in zip(windows, found_hz, strict=True)
    ]
    assert 0.75 < np.std(found_hz) / (TONE_HZ * np.sqrt(np.mean(np.square(stated)))) < 1.2


def test_the_pilot_does_not_beat_with_itself():
    assert pilot_beat_std_hz(1.0, 10e6, 10e6 * (1.0 + 99e-6), 1e5, 0.01) == 0.0
    assert pilot_beat_std_hz(1.0, 10e6, 10e6 * (1.0 + 101e-6), 1e5, 0.01) > 0.0
