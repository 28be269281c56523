"""Receives messages of every plate below a prefix, across restarts of the broker, in a thread of its own.

A busy consumer does not delay the times of arrival.
"""

import asyncio
import logging
import threading
import time
import uuid
from collections import deque
from collections.abc import AsyncGenerator, Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Final, NamedTuple

from paho.mqtt.client import topic_matches_sub
from paho.mqtt.enums import MQTTProtocolVersion
from pydantic import ValidationError

from resonator_daemon.base.host.text import printable
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import BrokerConnection
from resonator_daemon.mqtt.codec import Incoming, decode
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.reconnection import keep_connected
from resonator_daemon.mqtt.topics import TOPICS, Topic, full_topic, split_topic

END_TIMEOUT_S: Final = 2.0  # an attempt to connect cannot be cancelled
STREAM_AGE_MAX_S: Final = 0.25  # of a message of a stream, where the same topic has a newer one
STREAM_WAITING_MAX: Final = 1024  # the oldest are dropped
OTHERS_WAITING_MAX: Final = 65_536  # bounds the memory where a consumer never reads

EVERY_PLATE: Final = "+"  # MQTT's wildcard

_REASON_MAX: Final = 200  # characters
_TOPICS_MAX: Final = 1024  # that are remembered
_BY_PATH: Final = TOPICS | {topic.slow_path: topic for topic in TOPICS.values() if topic.slow_hz is not None}

log = logging.getLogger(__name__)


class Arrival(NamedTuple):
    """A message and its time of arrival, UTC."""

    topic: str
    payload: bytes
    arrived_ns: int


class Receiver:
    """Subscription to topics of a broker, across its restarts, from `start` to `close`.

    Parameters
    ----------
    broker
        Where to connect.
    connections
        For each connection its topic filters and their QoS. Connections are opened, and filters requested, in this
        order: when a message of the last filter has arrived, all others are subscribed.
    on_arrival
        Called in the receiving thread with each message. It must return at once.
    on_end
        Called in the receiving thread when that ends without `close`, which is a defect; `close` raises it.
    version
        Of MQTT; None: the latest that the broker knows. Packets of 3.1.1 cost half of those of 5.
    """

    def __init__(
        self,
        broker: Mqtt,
        connections: Sequence[Mapping[str, int]],
        on_arrival: Callable[[Arrival], None],
        on_end: Callable[[], None] = lambda: None,
        version: MQTTProtocolVersion | None = None,
    ) -> None:
        self._broker = broker
        self._version = version
        self._connections = connections
        self._on_arrival = on_arrival
        self._on_end = on_end
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closing: asyncio.Future[None] | None = None
        self._defect: BaseException | None = None
        self._reported = ""
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="receiver", daemon=True)

    def start(self) -> None:
        """Start the thread; returns when its event loop runs."""
        self._thread.start()
        self._ready.wait()

    async def close(self) -> None:
        """Disconnect; raise the defect that ended the thread, if one did."""
        if self._loop is not None and self._closing is not None:
            with suppress(RuntimeError):  # it has ended already
                self._loop.call_soon_threadsafe(_finish, self._closing)
            await asyncio.to_thread(self._thread.join, END_TIMEOUT_S)
        if self._defect is not None:
            raise self._defect

    def _run(self) -> None:
        try:
            asyncio.run(self._receive())
        except Exception as error:  # noqa: BLE001 - `close` raises it
            self._defect = error
        self._ready.set()
        self._on_end()

    async def _receive(self) -> None:
        self._loop = asyncio.get_running_loop()
        closing = self._closing = self._loop.create_future()
        self._ready.set()
        before: asyncio.Future[None] | None = None
        keeping = []
        for filters in self._connections:
            subscribed: asyncio.Future[None] = self._loop.create_future()
            keeping.append(self._keep(filters, before, subscribed, closing))
            before = subscribed
        await asyncio.gather(*keeping)

    async def _keep(
        self,
        filters: Mapping[str, int],
        before: asyncio.Future[None] | None,
        subscribed: asyncio.Future[None],
        closing: asyncio.Future[None],
    ) -> None:
        """Keep one connection, from when the one before it has subscribed for the first time."""

        @lru_cache(_TOPICS_MAX)
        def requested(topic: str) -> bool:  # amqtt delivers retained messages of other topics, too
            return any(topic_matches_sub(topic_filter, topic) for topic_filter in filters)

        def receive(message: Incoming) -> None:
            if requested(message.topic):
                self._on_arrival(Arrival(message.topic, message.payload, time.time_ns()))

        def make_connection(version: MQTTProtocolVersion) -> BrokerConnection:
            # amqtt takes connections without an identifier for a single client
            version = self._version or version
            return BrokerConnection(self._broker, version, identifier=uuid.uuid4().hex, on_message=receive)

        async def serve(connection: BrokerConnection) -> None:
            await asyncio.wait([connection.subscribe(*each) for each in filters.items()])
            _finish(subscribed)

        if before is not None:
            await asyncio.wait([before, closing], return_when=asyncio.FIRST_COMPLETED)
        await keep_connected(self._broker, make_connection, serve, closing, report=self._report)

    def _report(self, level: int, text: str) -> None:
        """Log a change of the connections, once where it is the same of all."""
        if text != self._reported:
            log.log(level, "%s", text)
        self._reported = text


def _finish(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


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
) -> AsyncGenerator[Received]:
    """Yield messages of plates below the broker's prefix as they come, the retained ones first, for ever.

    States and events (QoS 1) have a connection of their own: Mosquitto drops messages of QoS 1, too, for a connection
    with 1000 packets waiting, as when its reader is behind with streams.

    Without `full_rate`, of topics with a decimated topic, that one. Messages that cannot be read are passed over and
    logged; those of which `wanted` returns false, called with plate and path, are not decoded. If the consumer is slow,
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
                is_wanted = wanted(name, _BY_PATH[path].path)
                if is_wanted and (message := read_message(broker.prefix, arrival)) is not None:
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
