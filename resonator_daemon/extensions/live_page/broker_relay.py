"""Relay of what plates publish: payloads as they come from the broker, streams only of plates that somebody watches."""

import asyncio
import logging
from collections.abc import Callable, Collection
from typing import Any, Final

from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.extensions.live_page.protocol import STREAMS
from resonator_daemon.mqtt.broker_connection import MQTT_3, BrokerConnection
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.connecting import UNSUPPORTED_VERSION, RefusalError, code_of
from resonator_daemon.mqtt.reconnection import keep_connected
from resonator_daemon.mqtt.subscriber import EVERY_PLATE, topic_filters
from resonator_daemon.mqtt.topics import TOPICS, full_topic, split_topic

CONNECTING, CONNECTED, DENIED = "connecting", "connected", "denied"
NO_BROKER, REFUSED, LOST = "no_broker", "broker_refuses", "connection_lost"
RETAINED_S: Final = 1.0  # after a subscription: retained messages that have not arrived by then are gone
ROUND_S: Final = 1 / 60  # a display shows no more

log = logging.getLogger(__name__)

OnMessage = Callable[[str, str, bytes], None]
OnStatus = Callable[[dict[str, Any]], None]


class BrokerRelay:
    """Subscriber that decodes nothing, across restarts of the broker, as long as `run` lasts.

    States, info and events have a connection of their own, so that a broker never drops them behind streams.

    Parameters
    ----------
    broker
        Where to subscribe.
    on_message
        Called with plate, path below it and payload of each message; the payload is empty where a retained topic was
        cleared.
    on_status
        Called with the object `broker` of the page when the connection changes.
    """

    def __init__(self, broker: Mqtt, on_message: OnMessage, on_status: OnStatus) -> None:
        self._broker = broker
        self._on_message = on_message
        self._on_status = on_status
        self._watched: frozenset[tuple[str, str]] = frozenset()  # plate and path
        self._streams: BrokerConnection | None = None  # while connected
        self._streams_version: MQTTProtocolVersion | None = MQTT_3  # its packets cost half of those of version 5
        self._connected = False
        # Retained topics by plate and path: whether the present connection has delivered each.
        self._retained: dict[tuple[str, str], bool] = {}

    async def run(self) -> None:
        """Relay until cancelled."""
        closing = asyncio.get_running_loop().create_future()  # never done: there is no will to be taken back
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(
                keep_connected(
                    self._broker, self._make_connection, self._serve_states, closing, on_failure=self._failed
                )
            )
            tasks.create_task(
                keep_connected(
                    self._broker,
                    self._make_streams_connection,
                    self._serve_streams,
                    closing,
                    report=lambda _, text: log.debug("streams: %s", text),
                    on_failure=self._streams_failed,
                )
            )

    def watch(self, topics: Collection[tuple[str, str]]) -> None:
        """Receive streams of these plates and paths, and no others."""
        watched = frozenset(topics)
        before, self._watched = self._watched, watched
        if self._streams is not None and self._streams.connected:
            if gone := before - watched:
                self._streams.unsubscribe([self._full(*topic) for topic in sorted(gone)])
            for topic in sorted(watched - before):
                self._streams.subscribe(self._full(*topic), qos=0)

    def _full(self, plate: str, path: str) -> str:
        return full_topic(self._broker.prefix, plate, path)

    def _make_connection(self, version: MQTTProtocolVersion, *, read_pause_s: float = 0.0) -> BrokerConnection:
        return BrokerConnection(
            self._broker, version, on_message=self._receive, on_denied=self._denied, read_pause_s=read_pause_s
        )

    def _make_streams_connection(self, version: MQTTProtocolVersion) -> BrokerConnection:
        return self._make_connection(self._streams_version or version, read_pause_s=ROUND_S)

    def _streams_failed(self, error: Exception) -> None:
        if code_of(error) == UNSUPPORTED_VERSION:
            self._streams_version = None  # a broker without MQTT 3.1.1

    async def _serve_states(self, connection: BrokerConnection) -> None:
        topics = [topic for topic in TOPICS.values() if topic.qos]
        filters = topic_filters(self._broker.prefix, topics, plate=EVERY_PLATE, full_rate=True)
        self._retained = dict.fromkeys(self._retained, False)
        for topic_filter, qos in filters.items():
            connection.subscribe(topic_filter, qos)
        self._connected = True
        self._set_status(True, CONNECTED, "")
        over, _ = await asyncio.wait([connection.lost], timeout=RETAINED_S)
        if not over:
            # Topics that are no longer retained by the broker.
            for plate, path in [key for key, delivered in self._retained.items() if not delivered]:
                self._relay(plate, path, b"")
            await asyncio.wait([connection.lost])

    async def _serve_streams(self, connection: BrokerConnection) -> None:
        self._streams = connection
        try:
            for topic in sorted(self._watched):
                connection.subscribe(self._full(*topic), qos=0)
            await asyncio.wait([connection.lost])
        finally:
            self._streams = None

    def _receive(self, message: Incoming) -> None:
        plate, path = split_topic(self._broker.prefix, message.topic)
        if path in STREAMS and (plate, path) not in self._watched:  # of a subscription that has just ended
            return
        if path in TOPICS:  # amqtt delivers retained messages of other topics, too
            self._relay(plate, path, message.payload)

    def _relay(self, plate: str, path: str, payload: bytes) -> None:
        if not payload:
            self._retained.pop((plate, path), None)
        elif TOPICS[path].retained:
            self._retained[plate, path] = True
        self._on_message(plate, path, payload)

    def _failed(self, error: Exception) -> None:
        was_connected, self._connected = self._connected, False
        code = REFUSED if isinstance(error, RefusalError) else LOST if was_connected else NO_BROKER
        self._set_status(False, code, str(error))

    def _denied(self, topic_filter: str, reason: str) -> None:
        self._set_status(True, DENIED, f"the broker denies {topic_filter}: {reason}; see its access rules")

    def _set_status(self, connected: bool, code: str, reason: str) -> None:
        self._on_status({"connected": connected, "reason_code": code, "reason": reason})
