"""MQTT subscriber in a thread of its own, so that a busy consumer does not delay the times of arrival."""

import asyncio
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final, NamedTuple

import aiomqtt

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.connection import BrokerClient, keep_connected
from resonator_daemon.publishing.mqtt_messages import Incoming

END_TIMEOUT_S: Final = 2.0  # an attempt to connect cannot be cancelled


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
        await keep_connected(self._broker, self._make_client, self._serve, self._closing)

    def _make_client(self, version: aiomqtt.ProtocolVersion) -> BrokerClient:
        return BrokerClient(self._broker, version, on_message=self._received)

    def _received(self, message: Incoming) -> None:
        self._on_arrival(Arrival(message.topic, message.payload, time.time_ns()))

    async def _serve(self, client: BrokerClient) -> None:
        for topic_filter, qos in self._filters.items():
            await client.subscribe(topic_filter, qos=qos)
        # Not for ever: up to Python 3.11, a cancellation that meets the acknowledgement of a subscription is lost.
        await asyncio.wait([client.lost, *filter(None, [self._closing])], return_when=asyncio.FIRST_COMPLETED)


def _finish(closing: asyncio.Future[None]) -> None:
    if not closing.done():
        closing.set_result(None)
