"""Pauses between attempts double up to a limit, and messages pass at a lower rate by their own time."""

import random

import pytest

from resonator_daemon.mqtt.pacing import Backoff, Decimator

MS_NS = 1_000_000


def test_pauses_double_up_to_the_limit_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(random, "uniform", lambda _low, high: high)
    pauses = Backoff(0.1)
    assert [pauses.next_s(1.0) for _ in range(6)] == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.0, 1.0])
    assert [pauses.next_s(30.0) for _ in range(6)] == pytest.approx([2.0, 4.0, 8.0, 16.0, 30.0, 30.0])
    assert pauses.next_s(1.0) == 1.0
    pauses.reset()
    assert pauses.next_s(1.0) == pytest.approx(0.1)


def test_pauses_differ_and_are_never_shorter_than_half() -> None:
    drawn = [Backoff(1.0).next_s(1.0) for _ in range(200)]
    assert 0.5 <= min(drawn) < 0.6
    assert 0.9 < max(drawn) <= 1.0


@pytest.mark.parametrize(("source_hz", "rate_hz", "passed"), [(200, 20, 20), (100, 5, 5), (75, 20, 20), (10, 20, 10)])
def test_a_steady_rate_passes_at_the_rate_asked_for(source_hz: int, rate_hz: int, passed: int) -> None:
    chance = random.Random(3)
    decimator = Decimator(rate_hz)
    start_ns = 1_789_000_000_003_000_000
    count = 0
    for number in range(10 * source_hz):
        scatter_ns = chance.randrange(-MS_NS, MS_NS)
        count += decimator.lets_pass(start_ns + number * 1_000_000_000 // source_hz + scatter_ns)
    assert abs(count - 10 * passed) <= 1


def test_a_clock_that_is_set_back_silences_nothing() -> None:
    decimator = Decimator(20.0)
    assert decimator.lets_pass(10**18)
    assert not decimator.lets_pass(10**18 - 10 * MS_NS)  # late by one period: it had its turn
    assert decimator.lets_pass(10**18 - 3_600_000 * MS_NS)
