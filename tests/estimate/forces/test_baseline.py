import math

import numpy as np
import pytest

from resonator_daemon.estimate.forces.baseline import CommonMode

FLOOR_STD = 2e-7
READING_STD = 3e-9
STEP_S = 0.005


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
