import numpy as np
import pytest
from brute_force_board import record_of

from resonator_daemon.estimate.tones.frequency_estimators import Sums
from resonator_daemon.estimate.tones.quantisation import (
    EXCESS_LIMIT,
    beats,
    excess_bound,
    excess_bound_of_one,
    quantisation_excess,
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


def variance_ratio(rng, interval, jitter, stamps, windows):
    found = slopes(stamped(rng, interval, jitter, stamps, windows))
    return np.mean((found - interval) ** 2) / white_variance(jitter, stamps)


def records(ticks):
    return [Sums.of(record_of(row.astype(np.int64).tolist(), 0, 10)) for row in ticks]


GOLDEN = (5**0.5 - 1) / 2  # as far from all ratios of small numbers as can be


@pytest.mark.parametrize(
    ("interval", "jitter", "stamps"),
    [
        (1000 + 3e-4, 0.3, 1000),
        (1000 + 3e-4, 0.0, 1000),
        (1000 + 1.6e-3, 0.05, 1000),  # faster than the worst
        (1000.5 + 2e-4, 0.1, 2000),
        (1000 + 1 / 3 + 1e-4, 0.1, 2000),
        (1000.25 + 3e-5, 0.05, 4000),
        (1000.2 + 1e-4, 0.02, 3000),  # beats that help
        (1000.8 + 3e-4, 0.014, 1000),
        (1000 + GOLDEN, 0.0, 500),
        (1000 + 1e-4, 0.5, 2000),
    ],
)
def test_predicted_excess_is_that_of_stamps_written_out(interval, jitter, stamps):
    windows = 3000
    ratio = variance_ratio(np.random.default_rng(1), interval, jitter, stamps, windows)
    predicted = 1 + float(quantisation_excess(interval, jitter, stamps))
    assert ratio == pytest.approx(predicted, rel=4 * np.sqrt(2 / windows))


def test_stamps_a_whole_number_of_ticks_apart_all_have_the_same_error():
    # Without jitter nothing is left; with some, what jitter makes of it: no line, the rest white.
    assert quantisation_excess(1000.0, 0.0, 1000) == pytest.approx(-1, abs=2e-3)
    ratio = variance_ratio(np.random.default_rng(2), 1000.0, 0.15, 200, 4000)
    assert 1 + quantisation_excess(1000.0, 0.15, 200) == pytest.approx(ratio, rel=0.09)
    # As measured they are flagged: rounding takes a slow beat for none.
    assert beats(1000.0, 0.0, 1000)


def test_the_worst_line_is_0_57_n_times_white_noise_of_its_power():
    # max of 3 j1(x)^2 is 0.5704, by the table of spherical Bessel functions: j1(2.0816) = 0.4362.
    stamps, jitter = 10_000, 0.3
    line = np.exp(-((2 * np.pi * jitter) ** 2)) / (2 * np.pi**2)
    worst = max(quantisation_excess(1000 + np.linspace(0.3, 1.2, 91) / stamps, jitter, stamps))
    assert worst == pytest.approx(line * 0.5704 * stamps / (jitter**2 + 1 / 12), rel=2e-3)
    assert excess_bound(1000.0, jitter, stamps) == pytest.approx(worst, rel=1e-3)


def test_half_a_tick_of_jitter_is_enough_for_ten_thousand_stamps_and_0_7_for_a_million():
    near = 1000 + np.geomspace(1e-9, 1e-2, 400)
    assert not beats(near, 0.55, 10_000).any()
    assert beats(near, 0.35, 10_000).any()
    assert not beats(near, 0.70, 1_000_000).any()
    assert beats(near, 0.50, 1_000_000).any()


def test_second_differences_do_not_see_a_slow_beat():
    rng = np.random.default_rng(3)
    interval, stamps = 1000 + 6e-4, 1000
    ticks = stamped(rng, interval, 0.0, stamps, 400)
    assert np.mean((slopes(ticks) - interval) ** 2) > 100 * white_variance(0.0, stamps)
    parts = records(ticks)
    assert max(part.q2_ticks2 / (6 * part.second_differences) for part in parts) < 0.02 / 12
    assert beats(slopes(ticks), [stamp_jitter_ticks(part) for part in parts], stamps).all()


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
        flags = beats(measured[:looked_at], [[jitter] * looked_at, found], stamps).sum(axis=1)
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


def test_channels_are_told_apart_and_unknown_ones_are_not_flagged():
    interval = np.array([1000.0003, np.nan, 1000.37, 1000.5])
    assert beats(interval, 0.2, 1000).tolist() == [True, False, False, False]
    each = [float(quantisation_excess(value, 0.2, 1000)) for value in interval]
    np.testing.assert_allclose(quantisation_excess(interval, np.full(4, 0.2), np.full(4, 1000)), each, rtol=1e-12)
    assert np.isnan(each[1])


def test_one_tone_is_bounded_as_many_are():
    # On either side of where lines are added up one by one, slow lines and quick ones, many harmonics and a single one.
    for jitter in (0.0, 0.05, 0.074, 0.076, 0.2, 0.29, 0.31, 0.6, 0.7):
        for interval in (1000.0, 1000.0003, 999.5, 1000.3334, 1234.5678):
            for stamps in (3, 99, 1000):
                together = float(excess_bound(interval, jitter, stamps))
                assert excess_bound_of_one(interval, jitter, stamps) == pytest.approx(together, rel=1e-9, abs=1e-12)
