import math

import pytest

from resonator_daemon.measurement.baseline import CommonMode


def test_unknown_until_every_channel_was_heard_often_enough():
    mode = CommonMode(2, needed=3, memory=10)
    for _ in range(5):
        mode.update([1e-6, math.nan])
    assert not mode.known
    assert all(math.isnan(g) for g in mode.value)
    for _ in range(2):
        mode.update([1e-6, 2e-6])
    assert not mode.known
    mode.update([1e-6, 2e-6])
    assert mode.known
    assert mode.value == pytest.approx((1e-6, 2e-6))


def test_the_first_readings_are_averaged_plainly():
    mode = CommonMode(1, needed=4, memory=10)
    for reading in (1.0, 2.0, 3.0, 6.0):
        mode.update([reading])
    assert mode.value == pytest.approx((3.0,))


def test_later_readings_are_followed_with_the_stated_memory():
    mode = CommonMode(1, needed=1, memory=10)
    for _ in range(50):
        mode.update([0.0])
    for _ in range(10):
        mode.update([1.0])
    assert mode.value[0] == pytest.approx(1 - 0.9**10)


def test_reset_makes_it_unknown_again():
    mode = CommonMode(1, needed=2, memory=2)
    mode.update([5.0])
    mode.update([5.0])
    mode.reset()
    mode.update([1.0])
    assert not mode.known
    mode.update([1.0])
    assert mode.value == (1.0,)


@pytest.mark.parametrize(("needed", "memory"), [(0, 5), (6, 5)])
def test_impossible_lengths_are_refused(needed, memory):
    with pytest.raises(ValueError, match="readings needed"):
        CommonMode(1, needed=needed, memory=memory)
