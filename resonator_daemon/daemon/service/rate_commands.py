"""Further rates of streams, each on a topic of its own, for as long as somebody asks for it."""

import asyncio
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any, Final, NamedTuple, Protocol

from resonator_daemon.mqtt.commands import CommandRefusedError
from resonator_daemon.mqtt.topics import TOPICS
from resonator_daemon.mqtt.verbs import SetRate, SetRateAnswer

TOPICS_MAX: Final = 16


class Timers(Protocol):
    """The part of an event loop that leases need."""

    def time(self) -> float: ...
    def call_at(self, when: float, callback: Callable[..., object], *args: Any) -> asyncio.TimerHandle: ...


PublishRates = Callable[[Mapping[str, Collection[int]]], None]


class _Lease(NamedTuple):
    until_s: float  # of the event loop's clock
    until_utc_ns: int
    timer: asyncio.TimerHandle


class RateCommands:
    """Leases of further rates; a later request extends a lease and never shortens it, as others may rely on it.

    To be used from the event loop's thread only.

    Parameters
    ----------
    streams
        Paths of the topics that this daemon publishes as streams.
    publish_rates
        Called with the further rates of all streams, in Hz by path, when they have changed.
    timers
        Those of the event loop where not given.
    """

    def __init__(self, streams: Collection[str], publish_rates: PublishRates, *, timers: Timers | None = None) -> None:
        self._streams = streams
        self._publish_rates = publish_rates
        self._timers = timers or asyncio.get_running_loop()
        self._leases: dict[tuple[str, int], _Lease] = {}

    def set_rate(self, request: SetRate) -> SetRateAnswer:
        path, rate_hz = request.topic, request.rate_hz
        if path not in self._streams:
            published = ", ".join(self._streams)
            raise CommandRefusedError("not_published", f"this daemon does not publish {path}", f"streams: {published}")
        topic = TOPICS[path]
        until_t_ns = None if rate_hz == topic.slow_hz else self._extend(path, rate_hz, request.lease_s)
        return SetRateAnswer(topic=topic.path_at(rate_hz), rate_hz=rate_hz, until_t_ns=until_t_ns)

    def _extend(self, path: str, rate_hz: int, lease_s: int) -> int:
        """Return until when the topic is published, UTC."""
        key = path, rate_hz
        lease, until_s = self._leases.get(key), self._timers.time() + lease_s
        if lease is not None and lease.until_s >= until_s:
            return lease.until_utc_ns
        if lease is not None:
            lease.timer.cancel()
        elif len(self._leases) >= TOPICS_MAX:
            raise CommandRefusedError(
                "too_many_rates", f"{TOPICS_MAX} further rates are published already", "use one of rates_hz in info"
            )
        until_utc_ns = time.time_ns() + lease_s * 10**9
        self._leases[key] = _Lease(until_s, until_utc_ns, self._timers.call_at(until_s, self._end, key))
        if lease is None:
            self._changed()
        return until_utc_ns

    def _end(self, key: tuple[str, int]) -> None:
        del self._leases[key]
        self._changed()

    def _changed(self) -> None:
        rates_hz: dict[str, list[int]] = {}
        for path, rate_hz in self._leases:
            rates_hz.setdefault(path, []).append(rate_hz)
        self._publish_rates(rates_hz)
