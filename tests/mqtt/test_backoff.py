"""Pauses between attempts double, up to a limit that may change, and start anew."""

import random

import pytest

from resonator_daemon.mqtt.backoff import Backoff


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
