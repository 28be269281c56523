import math

import numpy as np
import pytest

from resonator_daemon.estimate.forces.baseline import COMMON_MODE_WALK, SPAN_S, WALKS, CommonMode, DriftWatch

FLOOR_STD = 2e-7
READING_STD = 3e-9
STEP_S = 0.005

NAN = math.nan
WATCH_STEP_S = 0.1


def learnt(channels=4, value=0.0):
    mode = CommonMode(channels, needed=20, reading_std=READING_STD)
    for _ in range(200):
        mode.update([value] * channels, STEP_S)
    return mode


def test_unknown_until_every_channel_was_heard_often_enough():
    mode = CommonMode(2, needed=3, reading_std=READING_STD)
    for _ in range(5):
        mode.update([1e-6, math.nan], STEP_S)
    assert not mode.known
    assert all(math.isnan(g) for g in mode.value)
    assert math.isnan(mode.std)
    for _ in range(2):
        mode.update([1e-6, 2e-6], STEP_S)
    assert not mode.known
    mode.update([1e-6, 2e-6], STEP_S)
    assert mode.known
    assert mode.value == pytest.approx((1e-6, 2e-6))


def test_the_first_readings_are_averaged_plainly():
    mode = CommonMode(1, needed=4, reading_std=1.0)  # noise far above any walk
    for reading in (1.0, 2.0, 3.0, 6.0):
        mode.update([reading], STEP_S)
    assert mode.value == pytest.approx((3.0,))


def test_a_drift_is_followed_while_untouched():
    mode = learnt()
    for k in range(2000):
        mode.update([1e-9 * k * STEP_S] * 4, STEP_S)  # 6e-7 in ten minutes
    assert mode.value == pytest.approx((1e-9 * 2000 * STEP_S,) * 4, abs=1e-10)


def test_a_held_value_stays_and_grows_less_certain():
    mode = learnt(value=1e-6)
    held = mode.value
    stds = []
    for _ in range(600):
        mode.update([math.nan] * 4, 1.0)
        stds.append(mode.std)
    assert mode.value == held
    assert stds[0] == pytest.approx(FLOOR_STD, rel=0.01)
    assert (np.diff(stds) > 0).all()
    # A random walk: its variance is proportional to the time.
    growth = np.array(stds) ** 2 - FLOOR_STD**2
    assert growth[599] / growth[149] == pytest.approx(4.0, rel=0.01)


def test_one_channel_that_is_not_heard_makes_the_whole_less_certain():
    mode = learnt()
    before = mode.std
    mode.update([0.0, 0.0, 0.0, math.nan], 600.0)
    assert mode.std > 1.5 * before


def test_tare_takes_the_present_readings_at_once():
    mode = learnt(2, 1e-6)
    mode.update([math.nan] * 2, 3600.0)
    mode.tare([3e-6, math.nan])
    assert mode.value == pytest.approx((3e-6, 1e-6), abs=1e-12)
    mode.tare([3e-6, 4e-6])
    assert mode.std == pytest.approx(FLOOR_STD, rel=0.01)
    fresh = CommonMode(1, needed=50, reading_std=READING_STD)
    fresh.tare([2e-6])
    assert fresh.value == (2e-6,)


def watch(path: np.ndarray, *, kelvin: float = NAN) -> list[str]:
    """Estimates of the common mode of two channels, the second at rest."""
    drift = DriftWatch()
    return [drift.update((float(g), 0.0), kelvin, n * WATCH_STEP_S) for n, g in enumerate(path)]


def ramp(walks_in_span: float, seconds: float) -> np.ndarray:
    limit = COMMON_MODE_WALK * math.sqrt(SPAN_S)
    return walks_in_span * limit * np.arange(0.0, seconds, WATCH_STEP_S) / SPAN_S


def test_a_ramp_is_told_of_from_five_walks_in_ten_seconds_on() -> None:
    assert not any(watch(ramp(0.95 * WALKS, 60.0)))
    told = watch(ramp(1.1 * WALKS, 60.0))
    assert all(told[round(SPAN_S / WATCH_STEP_S) + 6 :])


def test_it_ends_when_the_plate_is_at_rest_again() -> None:
    moving = ramp(3.0 * WALKS, 20.0)
    rest = moving[-1] + 1e-12 * np.arange(300)  # measured again each time
    told = watch(np.concatenate([moving, rest]))
    assert told[199]
    assert not any(told[199 + round(SPAN_S / WATCH_STEP_S) + 10 :])


def test_a_random_walk_of_the_stated_size_is_no_drift() -> None:
    steps = np.random.default_rng(3).normal(size=20_000)
    assert not any(watch(COMMON_MODE_WALK * math.sqrt(WATCH_STEP_S) * np.cumsum(steps)))


def test_a_held_common_mode_tells_nothing_and_may_have_moved_when_it_is_heard_again() -> None:
    held = np.full(round(100.0 / WATCH_STEP_S), 0.0)
    before = 1e-13 * np.arange(100)
    jump = 0.9 * WALKS * COMMON_MODE_WALK * math.sqrt(100.0)
    told = watch(np.concatenate([before, held + before[-1], jump + before]))
    assert not any(told)


def test_temperature_counts_where_it_is_measured() -> None:
    drift = DriftWatch()
    told = [drift.update((1e-15 * n, NAN), 0.5 * n * WATCH_STEP_S, n * WATCH_STEP_S) for n in range(200)]
    assert told[-1]


def test_a_baseline_that_is_forgotten_begins_anew() -> None:
    drift = DriftWatch()
    for n in range(100):
        drift.update((1e-9 * n, 0.0), NAN, n * WATCH_STEP_S)
    assert drift.update((NAN, NAN), NAN, 10.0) is None
    assert not any(drift.update((1.0 + 1e-15 * n, 0.0), NAN, 10.1 + n * WATCH_STEP_S) for n in range(100))


def test_with_time_that_goes_backwards_it_begins_anew() -> None:
    drift = DriftWatch()
    told = [drift.update((1e-6 * n, 0.0), NAN, 100.0 + n * WATCH_STEP_S) for n in range(100)]
    assert told[-1]
    assert drift.update((1.0, 0.0), NAN, 0.0) is None
    assert not any(drift.update((1.0 + 1e-13 * n, 0.0), NAN, n * WATCH_STEP_S) for n in range(1, 100))
