"""Further rates of streams: each on a topic of its own, as long as somebody asks for it."""

import asyncio
from collections.abc import Callable, Collection, Mapping
from typing import Any

import pytest

from resonator_daemon.daemon.service.rate_commands import TOPICS_MAX, RateCommands
from resonator_daemon.mqtt.commands import CommandRefusedError
from resonator_daemon.mqtt.verbs import SetRate, SetRateAnswer


class Clock:
    """Timers by hand."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._timers: list[asyncio.TimerHandle] = []

    def time(self) -> float:
        return self.now_s

    def call_at(self, when: float, callback: Callable[..., object], *args: Any) -> asyncio.TimerHandle:
        self._timers.append(asyncio.TimerHandle(when, callback, args, asyncio.get_running_loop()))
        return self._timers[-1]

    def advance(self, seconds: float) -> None:
        self.now_s += seconds
        for timer in [each for each in self._timers if each.when() <= self.now_s]:
            self._timers.remove(timer)
            if not timer.cancelled():
                timer._run()


class Bench:
    def __init__(self) -> None:
        self.clock = Clock()
        self.published: list[dict[str, set[int]]] = []
        self.commands = RateCommands(("forces", "contacts"), self._publish, timers=self.clock)

    def _publish(self, rates_hz: Mapping[str, Collection[int]]) -> None:
        self.published.append({path: set(rates) for path, rates in rates_hz.items()})

    def ask(self, topic: str, rate_hz: int, lease_s: int = 60) -> SetRateAnswer:
        return self.commands.set_rate(SetRate(topic=topic, rate_hz=rate_hz, lease_s=lease_s))

    def refusal(self, topic: str, rate_hz: int) -> str:
        with pytest.raises(CommandRefusedError) as refused:
            self.ask(topic, rate_hz)
        return refused.value.code


@pytest.fixture
async def bench() -> Bench:
    return Bench()


async def test_a_rate_lasts_for_its_lease(bench: Bench) -> None:
    assert SetRate(topic="forces", rate_hz=5).lease_s == 60
    assert bench.ask("forces", 5).topic == "forces/5hz"
    bench.clock.advance(30)
    assert bench.ask("forces", 7).topic == "forces/7hz"
    assert bench.ask("contacts", 5).topic == "contacts/5hz"
    bench.clock.advance(59)
    assert bench.published[:3] == [{"forces": {5}}, {"forces": {5, 7}}, {"forces": {5, 7}, "contacts": {5}}]
    assert bench.published[3:] == [{"forces": {7}, "contacts": {5}}]
    bench.clock.advance(1)
    assert bench.published[-1] == {}


async def test_asking_again_extends_a_lease_and_never_shortens_it(bench: Bench) -> None:
    first = bench.ask("forces", 5, lease_s=100)
    assert bench.ask("forces", 5, lease_s=1).until_t_ns == first.until_t_ns
    bench.clock.advance(90)
    later = bench.ask("forces", 5, lease_s=100)
    assert later.until_t_ns is not None
    assert first.until_t_ns is not None
    assert later.until_t_ns > first.until_t_ns
    bench.clock.advance(99)
    assert bench.published == [{"forces": {5}}]
    bench.clock.advance(1)
    assert bench.published == [{"forces": {5}}, {}]


async def test_a_fixed_rate_is_there_without_a_lease(bench: Bench) -> None:
    assert bench.ask("forces", 20) == SetRateAnswer(topic="forces/20hz", rate_hz=20, until_t_ns=None)
    assert bench.published == []


async def test_rates_are_few_and_those_that_are_there_can_be_renewed(bench: Bench) -> None:
    for rate_hz in range(1, TOPICS_MAX + 1):
        bench.ask("forces", rate_hz)
    assert bench.refusal("contacts", 1) == "too_many_rates"
    assert bench.ask("forces", 1).topic == "forces/1hz"
    assert bench.ask("contacts", 20).topic == "contacts/20hz"
    bench.clock.advance(60)
    assert bench.ask("contacts", 1).topic == "contacts/1hz"


async def test_a_stream_that_the_daemon_does_not_publish_has_no_rates(bench: Bench) -> None:
    assert bench.refusal("decoded", 1) == "not_published"
    assert bench.published == []
