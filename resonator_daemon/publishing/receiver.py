"""MQTT subscriber in a thread of its own, so that a busy consumer does not delay the times of arrival."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Final, NamedTuple

import aiomqtt

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing import connection_errors
from resonator_daemon.publishing.broker_connection import ConnectionTimes
from resonator_daemon.publishing.connection_errors import BrokerError
from resonator_daemon.publishing.reconnection import Attempt, keep_connected
from resonator_daemon.publishing.tls import make_tls

END_TIMEOUT_S: Final = 2.0  # an attempt to connect cannot be cancelled

_CANCEL_AGAIN_S: Final = 0.1

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
    filters
        Topic filters and their QoS, in the order in which they are requested.
    on_arrival
        Called in the receiving thread with each message. It must return at once.
    on_end
        Called in the receiving thread when that ends without `close`, which is a defect; `close` raises it.
    """

    def __init__(
        self,
        broker: Mqtt,
        filters: Mapping[str, int],
        on_arrival: Callable[[Arrival], None],
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._broker = broker
        self._filters = filters
        self._on_arrival = on_arrival
        self._on_end = on_end
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closing: asyncio.Future[None] | None = None
        self._defect: BaseException | None = None
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
        self._closing = self._loop.create_future()
        self._ready.set()
        await keep_connected(self._broker, self._session, self._closing)

    async def _session(self, attempt: Attempt) -> None:
        """Receive until the connection is lost, or the receiver is closed."""
        receiving = asyncio.create_task(self._receive_from_broker(attempt))
        ends: list[asyncio.Future[Any]] = [receiving, *filter(None, [self._closing])]
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        while not receiving.done():
            receiving.cancel()  # up to Python 3.11 a cancellation that meets an acknowledgement is lost
            await asyncio.wait([receiving], timeout=_CANCEL_AGAIN_S)
        if not receiving.cancelled():
            receiving.result()

    async def _receive_from_broker(self, attempt: Attempt) -> None:
        accepted = False
        try:
            async with self._make_client(attempt) as client:
                accepted = True
                attempt.accepted()
                for topic_filter, qos in self._filters.items():
                    await client.subscribe(topic_filter, qos=qos)
                async for message in client.messages:
                    if isinstance(message.payload, bytes):
                        self._on_arrival(Arrival(message.topic.value, message.payload, time.time_ns()))
        except aiomqtt.MqttError as error:
            raise _broker_error(error, self._broker, accepted=accepted) from None

    def _make_client(self, attempt: Attempt) -> aiomqtt.Client:
        times = ConnectionTimes()
        return aiomqtt.Client(
            self._broker.host,
            self._broker.port,
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
        return connection_errors.of_opening(error.__context__, broker)
    return BrokerError(connection_errors.SILENT)


def _finish(closing: asyncio.Future[None]) -> None:
    if not closing.done():
        closing.set_result(None)
