"""Receives messages of every plate below a prefix, across restarts of the broker."""

import asyncio
import logging
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable, Collection
from contextlib import suppress
from typing import Final, NamedTuple

from pydantic import ValidationError

from resonator_daemon.base.host.text import printable
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.codec import decode
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.receiver import Arrival, Receiver
from resonator_daemon.mqtt.topics import TOPICS, Topic, full_topic, split_topic

STREAM_AGE_MAX_S: Final = 0.25  # of a message of a stream, where the same topic has a newer one
STREAM_WAITING_MAX: Final = 1024  # the oldest are dropped
OTHERS_WAITING_MAX: Final = 65_536  # bounds the memory where a consumer never reads

EVERY_PLATE: Final = "+"  # MQTT's wildcard

_REASON_MAX: Final = 200  # characters

log = logging.getLogger(__name__)

_BY_PATH: Final = TOPICS | {topic.slow_path: topic for topic in TOPICS.values() if topic.slow_hz is not None}


class Received(NamedTuple):
    """A message, from which plate and on which topic below it; of a decimated topic its main topic."""

    plate: str
    path: str
    message: Message


async def subscribe(
    broker: Mqtt,
    topics: Collection[Topic[Message]] = tuple(TOPICS.values()),
    *,
    plate: str = EVERY_PLATE,
    full_rate: bool = True,
    wanted: Callable[[str, str], bool] = lambda plate, path: True,
    on_cleared: Callable[[str, str], None] = lambda plate, path: None,
) -> AsyncGenerator[Received]:
    """Yield messages of plates below the broker's prefix as they come, the retained ones first, for ever.

    States and events (QoS 1) have a connection of their own: Mosquitto drops messages of QoS 1, too, for a connection
    with 1000 packets waiting, as when its reader is behind with streams.

    Without `full_rate`, of topics with a decimated topic, that one. Messages that cannot be read are passed over and
    logged; those of which `wanted` returns false, called with plate and path, are not decoded. `on_cleared` is called
    likewise where a retained topic was cleared, in the order of the messages. If the consumer is slow,
    messages of streams (QoS 0) older than 250 ms are dropped where their topic has a newer one; states and events are
    all kept. To stop, close the iterator (contextlib.aclosing).
    """
    loop = asyncio.get_running_loop()
    arrived = asyncio.Event()
    waiting = _Waiting(broker.prefix)

    def on_arrival(arrival: Arrival) -> None:
        if waiting.append(arrival):
            wake()

    def on_end() -> None:
        waiting.over = True
        wake()

    def wake() -> None:
        with suppress(RuntimeError):  # the consumer's loop has ended without closing the iterator
            loop.call_soon_threadsafe(arrived.set)

    filters = topic_filters(broker.prefix, topics, plate=plate, full_rate=full_rate)
    streams = {topic_filter: qos for topic_filter, qos in filters.items() if qos == 0}
    others = {topic_filter: qos for topic_filter, qos in filters.items() if qos}
    receiver = Receiver(broker, [each for each in (streams, others) if each], on_arrival, on_end)
    receiver.start()
    try:
        while not waiting.over:
            await arrived.wait()
            arrived.clear()
            while (arrival := waiting.pop()) is not None:
                name, path = split_topic(broker.prefix, arrival.topic)
                if not arrival.payload:
                    on_cleared(name, path)
                elif (
                    wanted(name, _BY_PATH[path].path) and (message := read_message(broker.prefix, arrival)) is not None
                ):
                    yield message
    finally:
        await receiver.close()


def topic_filters(
    prefix: str, topics: Collection[Topic[Message]], *, plate: str = EVERY_PLATE, full_rate: bool
) -> dict[str, int]:
    """Return topic filters for plates below the prefix with their QoS, in the order in which to subscribe."""
    # Retained topics last: when a state has arrived, all other topics are subscribed.
    return {
        full_topic(prefix, plate, topic.path if full_rate or topic.slow_hz is None else topic.slow_path): topic.qos
        for topic in sorted(topics, key=lambda topic: topic.retained)
    }


class _Waiting:
    """Queue between the receiving thread, which appends, and the consumer, which pops."""

    def __init__(self, prefix: str) -> None:
        self.over = False
        self._prefix = prefix
        self._streams: deque[Arrival] = deque(maxlen=STREAM_WAITING_MAX)
        self._others: deque[Arrival] = deque(maxlen=OTHERS_WAITING_MAX)
        self._newest_ns: dict[str, int] = {}  # by topic, of streams

    def append(self, arrival: Arrival) -> bool:
        """Append a message; return whether it is the only one."""
        _, path = split_topic(self._prefix, arrival.topic)
        if _BY_PATH[path].qos:
            self._others.append(arrival)
        else:
            self._newest_ns[arrival.topic] = arrival.arrived_ns
            self._streams.append(arrival)
        return len(self._streams) + len(self._others) == 1

    def pop(self) -> Arrival | None:
        """Remove and return the oldest message; discard old ones of streams that have newer ones; None if empty."""
        stale_ns = time.time_ns() - round(STREAM_AGE_MAX_S * 1e9)
        while self._streams:
            if self._others and self._others[0].arrived_ns <= self._streams[0].arrived_ns:
                break
            arrival = self._streams.popleft()
            if arrival.arrived_ns >= min(stale_ns, self._newest_ns[arrival.topic]):
                return arrival
        return self._others.popleft() if self._others else None


def read_message(prefix: str, arrival: Arrival) -> Received | None:
    """Read a message of a plate below the prefix; log why it cannot be read. None then, and where it is empty."""
    if not arrival.payload:  # what the broker retained was cleared
        return None
    plate, path = split_topic(prefix, arrival.topic)
    kind = _BY_PATH[path]
    try:
        return Received(plate, kind.path, decode(kind.payload, arrival.payload))
    except (ValueError, RecursionError, OverflowError) as error:
        log.warning("%s: message cannot be read: %s", printable(arrival.topic), printable(_reason(error)))
        return None


def _reason(error: Exception) -> str:
    """Return what is wrong with a payload: of its fields, the first that is."""
    if not isinstance(error, ValidationError):
        return str(error)[:_REASON_MAX]
    first, *others = error.errors(include_url=False, include_input=False)
    where = ".".join(str(part) for part in first["loc"])
    more = f" (and {len(others)} more)" if others else ""
    return f"{where}{': ' if where else ''}{first['msg']}"[:_REASON_MAX] + more
