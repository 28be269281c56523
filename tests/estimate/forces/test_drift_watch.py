"""A common mode that moves faster than the baseline's walk explains."""

import math

import numpy as np

from resonator_daemon.estimate.forces.baseline import COMMON_MODE_WALK
from resonator_daemon.estimate.forces.drift_watch import SPAN_S, WALKS, DriftWatch

NAN = math.nan
STEP_S = 0.1


def watch(path: np.ndarray, *, kelvin: float = NAN) -> list[str]:
    """What is told of a common mode of two channels, the second at rest."""
    drift = DriftWatch()
    return [drift.update((float(g), 0.0), kelvin, n * STEP_S) for n, g in enumerate(path)]


def ramp(walks_in_span: float, seconds: float) -> np.ndarray:
    limit = COMMON_MODE_WALK * math.sqrt(SPAN_S)
    return walks_in_span * limit * np.arange(0.0, seconds, STEP_S) / SPAN_S


def test_a_ramp_is_told_of_from_five_walks_in_ten_seconds_on() -> None:
    assert not any(watch(ramp(0.95 * WALKS, 60.0)))
    told = watch(ramp(1.1 * WALKS, 60.0))
    assert all(told[round(SPAN_S / STEP_S) + 6 :])


def test_it_ends_when_the_plate_is_at_rest_again() -> None:
    moving = ramp(3.0 * WALKS, 20.0)
    rest = moving[-1] + 1e-12 * np.arange(300)  # measured anew each time
    told = watch(np.concatenate([moving, rest]))
    assert told[199]
    assert not any(told[199 + round(SPAN_S / STEP_S) + 10 :])


def test_a_random_walk_of_the_stated_size_is_no_drift() -> None:
    steps = np.random.default_rng(3).normal(size=20_000)
    assert not any(watch(COMMON_MODE_WALK * math.sqrt(STEP_S) * np.cumsum(steps)))


def test_a_held_common_mode_tells_nothing_and_may_have_moved_when_it_is_heard_again() -> None:
    held = np.full(round(100.0 / STEP_S), 0.0)
    before = 1e-13 * np.arange(100)
    jump = 0.9 * WALKS * COMMON_MODE_WALK * math.sqrt(100.0)
    told = watch(np.concatenate([before, held + before[-1], jump + before]))
    assert not any(told)


def test_temperature_counts_where_it_is_measured() -> None:
    drift = DriftWatch()
    told = [drift.update((1e-15 * n, NAN), 0.5 * n * STEP_S, n * STEP_S) for n in range(200)]
    assert told[-1]


def test_a_baseline_that_is_forgotten_begins_anew() -> None:
    drift = DriftWatch()
    for n in range(100):
        drift.update((1e-9 * n, 0.0), NAN, n * STEP_S)
    assert drift.update((NAN, NAN), NAN, 10.0) is None
    assert not any(drift.update((1.0 + 1e-15 * n, 0.0), NAN, 10.1 + n * STEP_S) for n in range(100))


def test_with_time_that_goes_backwards_it_begins_anew() -> None:
    drift = DriftWatch()
    told = [drift.update((1e-6 * n, 0.0), NAN, 100.0 + n * STEP_S) for n in range(100)]
    assert told[-1]
    assert drift.update((1.0, 0.0), NAN, 0.0) is None
    assert not any(drift.update((1.0 + 1e-13 * n, 0.0), NAN, n * STEP_S) for n in range(1, 100))
