"""MQTT subscriber in a thread of its own, so that a busy consumer does not delay the times of arrival."""

import asyncio
import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from typing import Any, Final, NamedTuple

import aiomqtt

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import connecting
from resonator_daemon.mqtt.broker_connection import ConnectionTimes
from resonator_daemon.mqtt.connecting import BrokerError, make_tls
from resonator_daemon.mqtt.reconnection import Attempt, keep_connected

END_TIMEOUT_S: Final = 2.0  # an attempt to connect cannot be cancelled

_CANCEL_AGAIN_S: Final = 0.1
_TOPICS_MAX: Final = 1024  # that are remembered

log = logging.getLogger(__name__)
_library_log = logging.getLogger(f"{__name__}.aiomqtt")
_library_log.setLevel(logging.CRITICAL)  # it logs each failure; `keep_connected` logs changes


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
    """

    def __init__(
        self,
        broker: Mqtt,
        connections: Sequence[Mapping[str, int]],
        on_arrival: Callable[[Arrival], None],
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._broker = broker
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
        if before is not None:
            await asyncio.wait([before, closing], return_when=asyncio.FIRST_COMPLETED)
        await keep_connected(self._broker, partial(self._session, filters, subscribed), closing, report=self._report)

    def _report(self, level: int, text: str) -> None:
        """Log a change of the connections, once where it is the same of all."""
        if text != self._reported:
            log.log(level, "%s", text)
        self._reported = text

    async def _session(self, filters: Mapping[str, int], subscribed: asyncio.Future[None], attempt: Attempt) -> None:
        """Receive until the connection is lost, or the receiver is closed."""
        receiving = asyncio.create_task(self._receive_from_broker(filters, subscribed, attempt))
        ends: list[asyncio.Future[Any]] = [receiving, *filter(None, [self._closing])]
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        while not receiving.done():
            receiving.cancel()  # up to Python 3.11 a cancellation that meets an acknowledgement is lost
            await asyncio.wait([receiving], timeout=_CANCEL_AGAIN_S)
        if not receiving.cancelled():
            receiving.result()

    async def _receive_from_broker(
        self, filters: Mapping[str, int], subscribed: asyncio.Future[None], attempt: Attempt
    ) -> None:
        accepted = False

        @lru_cache(_TOPICS_MAX)
        def requested(topic: aiomqtt.Topic) -> bool:  # amqtt delivers retained messages of other topics, too
            return any(topic.matches(topic_filter) for topic_filter in filters)

        try:
            async with self._make_client(attempt) as client:
                accepted = True
                attempt.accepted()
                for topic_filter, qos in filters.items():
                    await client.subscribe(topic_filter, qos=qos)
                _finish(subscribed)
                async for message in client.messages:
                    if isinstance(message.payload, bytes) and requested(message.topic):
                        self._on_arrival(Arrival(message.topic.value, message.payload, time.time_ns()))
        except aiomqtt.MqttError as error:
            raise _broker_error(error, self._broker, accepted=accepted) from None

    def _make_client(self, attempt: Attempt) -> aiomqtt.Client:
        times = ConnectionTimes()
        return aiomqtt.Client(
            self._broker.host,
            self._broker.port,
            identifier=uuid.uuid4().hex,  # amqtt takes connections without one for a single client
            username=self._broker.username,
            password=self._broker.password,
            protocol=aiomqtt.ProtocolVersion(attempt.version),
            tls_context=make_tls(self._broker) if self._broker.tls else None,
            keepalive=times.keepalive_s,
            timeout=times.connect_s,
            logger=_library_log,
        )


def _broker_error(error: aiomqtt.MqttError, broker: Mqtt, *, accepted: bool) -> BrokerError:
    """Return an error of the library with the cause that it found."""
    if isinstance(error, aiomqtt.MqttCodeError):
        return BrokerError(str(error.rc), code=getattr(error.rc, "value", None))
    if accepted:
        return BrokerError("connection lost")
    if isinstance(error.__context__, OSError):
        return connecting.of_opening(error.__context__, broker)
    return connecting.SilentError(broker)


def _finish(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)
