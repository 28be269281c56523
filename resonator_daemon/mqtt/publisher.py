"""Publishes messages without ever waiting for the broker, and accounts for each of them."""

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from paho.mqtt.client import topic_matches_sub
from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import MQTT_5, BrokerConnection, ConnectionTimes
from resonator_daemon.mqtt.codec import Encoded, Incoming, Outgoing, encode
from resonator_daemon.mqtt.event_log import EventPage
from resonator_daemon.mqtt.message_account import Account, Cause
from resonator_daemon.mqtt.outbox import Outbox
from resonator_daemon.mqtt.pacing import Decimator
from resonator_daemon.mqtt.packets import Packet, StreamPackets, pack, properties_of
from resonator_daemon.mqtt.payloads import ContactEvent, Header, Message, MessageAccount
from resonator_daemon.mqtt.reconnection import keep_connected
from resonator_daemon.mqtt.topics import JSON, MessageT, Topic

FRESH_S: Final = 0.25  # streams of a live sensor that have waited longer are dropped

log = logging.getLogger(__name__)


class Subscription(NamedTuple):
    """Topic filter and handler of its messages; of a shared one, `$share/group/filter`, the filter alone is matched."""

    topic_filter: str
    qos: int
    handle: Callable[[Incoming], None]
    retain_as_published: bool = False  # with MQTT 5: `Incoming.retained` is that of the sender

    def matches(self, topic: str) -> bool:
        shared = self.topic_filter.startswith("$share/")
        return topic_matches_sub(self.topic_filter.split("/", 2)[2] if shared else self.topic_filter, topic)


class _Stream:
    """Packets of a stream, and those of its decimated topic, if it has one."""

    def __init__(self, base: str, topic: Topic[Any]) -> None:
        paths = (topic.path,) if topic.slow_hz is None else (topic.path, topic.slow_path)
        self.packets = tuple(
            StreamPackets(f"{base}/{path}", properties_of(topic), perishable=topic.perishable) for path in paths
        )
        self.decimator = None if topic.slow_hz is None else Decimator(topic.slow_hz)


class Publisher:
    """Sends messages to one broker, whether it is there or not; to be used from the event loop's thread only.

    Streams (QoS 0) are dropped while there is no connection, and the oldest first when the broker does not keep up.
    Events (QoS 1) wait for a connection, on disk where there is a spool. Of a retained topic the last message is kept,
    and sent again with each new connection. Each message is in exactly one term of `account`.

    Parameters
    ----------
    broker
        Address and credentials.
    identifier
        Of the client: of two connections with one identifier the broker ends the older one.
    make_will
        Makes the last will of each connection.
    subscriptions
        Renewed with each connection. What `handle` raises is logged once, and costs nothing but that message.
    spool_directory
        Where events wait; None: in memory alone.
    boot_id
        Of this run of the daemon, whose events are stored next to those that wait; None: they are not.
    on_connected
        Called with the number of each connection, before the retained messages are sent again.
    stream_wait_max_s
        How long a measured message may wait for the socket, in seconds; older ones are skipped.
    times
        Of the connections.

    Attributes
    ----------
    counts
        Messages by outcome, but for those that wait; `account` is complete.
    """

    def __init__(
        self,
        broker: Mqtt,
        *,
        identifier: str,
        make_will: Callable[[], Outgoing],
        subscriptions: Sequence[Subscription] = (),
        spool_directory: Path | None = None,
        boot_id: str | None = None,
        on_connected: Callable[[int], None] = lambda _: None,
        stream_wait_max_s: float = math.inf,
        times: ConnectionTimes | None = None,
    ) -> None:
        self._broker = broker
        self._times = times or ConnectionTimes()
        self._identifier = identifier
        self._make_will = make_will
        self._subscriptions = subscriptions
        self._on_connected = on_connected
        self._client: BrokerConnection | None = None
        self._connections = 0
        self.counts = Account()
        self._outbox = Outbox(self.counts, spool_directory, stream_wait_max_s, boot_id=boot_id)
        self._streams: dict[tuple[str, str], _Stream] = {}  # by base and path
        self._denied: set[str] = set()  # filters whose refusal was logged
        self._defects: set[tuple[str, type[Exception]]] = set()  # filters, and kinds of errors that were logged
        self._closed = False
        self._closing: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._ended = asyncio.Event()
        self._ended.set()

    @property
    def connected(self) -> bool:
        return self._client is not None

    @property
    def protocol(self) -> Literal["5", "3.1.1"] | None:
        """Version of MQTT of the present connection; None where there is none."""
        if self._client is None:
            return None
        return "5" if self._client.version is MQTT_5 else "3.1.1"

    @property
    def account(self) -> MessageAccount:
        return self.counts.message(waiting=self._outbox.waiting, spooled=self._outbox.events.spooled)

    def publish(self, base: str, topic: Topic[MessageT], message: MessageT | Encoded) -> None:
        """Send a message below `base` as soon as may be, or drop it by the rules of its topic; returns at once.

        Messages of streams (QoS 0) may be encoded already.
        """
        if topic.qos == 0 and isinstance(message, (topic.payload, Encoded)):
            self._publish_stream(base, topic, message)
            return
        if not isinstance(message, topic.payload):
            raise ValueError(f"{topic.path} carries {topic.payload.__name__}, not {type(message).__name__}")
        name = f"{base}/{topic.path}"
        if self._make(name, Cause.CLOSED if self._closed else None):
            if topic.retained:
                self._outbox.put_retained(Packet(name, encode(message), properties_of(topic)))
            elif isinstance(message, ContactEvent):
                self._outbox.put_event(name, message)

    def batch(self) -> AbstractContextManager[None]:
        """Send what is published within this context as one batch, at its end."""
        return self._outbox

    def retain(self, full_topic: str, payload: bytes, content_type: str) -> None:
        """Publish a document that is no message, to be kept by the broker."""
        if self._make(full_topic, Cause.CLOSED if self._closed else None):
            self._outbox.put_retained(Packet(full_topic, payload, pack(content_type=content_type)))

    def restore_now(self) -> None:
        """Publish all retained messages again: another client has overwritten some."""
        if self.connected:
            self._outbox.republish()

    def answer(self, outgoing: Outgoing) -> None:
        """Send an answer to a command, after all events: a flood of commands causes no loss of events."""
        if self._make(outgoing.topic, Cause.WITHDRAWN if self._closed or not self.connected else None):
            properties = pack(content_type=JSON, expiry_s=outgoing.expiry_s, correlation=outgoing.correlation)
            self._outbox.put_answer(Packet(outgoing.topic, outgoing.payload, properties))

    async def stored_events(self, boot_id: str | None, after_seq: int, bytes_max: int) -> EventPage:
        """Return stored events, as of `EventLog.page`."""
        return await self._outbox.events.page(boot_id, after_seq, bytes_max)

    async def run(self) -> None:
        """Keep connected until `close`; when cancelled instead, the broker publishes the last will."""
        self._ended.clear()
        self._outbox.events.start(self._end)
        try:
            await keep_connected(self._broker, self._make_connection, self._serve, self._closing, times=self._times)
        finally:
            self._closed = True
            self._outbox.drop_states()
            try:
                await self._outbox.events.close()
            finally:
                self.counts.close()
                self._ended.set()

    async def close(
        self, farewell: tuple[str, Topic[Any], Message] | None = None, *, wait_for_broker: bool = False
    ) -> None:
        """Publish a last message after all others, wait up to 2 s until all are sent, and end `run`.

        Parameters
        ----------
        farewell
            Base, topic and payload of the final message.
        wait_for_broker
            Also where there is no connection yet, because why the daemon ends is worth the time.
        """
        end_s = asyncio.get_running_loop().time() + self._times.close_s
        if farewell is not None:
            if self.connected:  # else events would be sent after it
                await self._all_sent(end_s - self._times.close_s / 2)
            self.publish(*farewell)
        self._closed = True
        if self.connected or wait_for_broker:
            await self._all_sent(end_s)
        self._end()
        await self._ended.wait()

    async def _all_sent(self, end_s: float) -> None:
        """Wait until all messages are sent, at most until this time of the event loop."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(end_s):
                await self._outbox.all_sent()

    def _end(self) -> None:
        if not self._closing.done():
            self._closing.set_result(None)

    def _make(self, topic: str, refused: Cause | None) -> bool:
        """Count a message; return whether it may be queued."""
        self.counts.enqueued += 1
        if refused is not None:
            self.counts.drop(refused, topic)
        return refused is None

    def _publish_stream(self, base: str, topic: Topic[MessageT], message: MessageT | Encoded) -> None:
        """Queue the message, and the same bytes on the decimated topic if its rate lets it pass."""
        stream = self._streams.get((base, topic.path))
        if stream is None:
            stream = self._streams[base, topic.path] = _Stream(base, topic)
        t_ns = message.t_ns if isinstance(message, (Encoded, Header)) else 0
        is_decimated = stream.decimator is not None and stream.decimator.lets_pass(t_ns)
        wanted = stream.packets if is_decimated else stream.packets[:1]
        self.counts.enqueued += len(wanted)
        if self._closed or self._client is None:
            absent = Cause.NO_CONNECTION if self._connections else Cause.NOT_CONNECTED_YET
            for packets in wanted:
                self.counts.drop(Cause.CLOSED if self._closed else absent, packets.topic)
            return
        payload = message.payload if isinstance(message, Encoded) else encode(message)
        for packets in wanted:
            self._outbox.put_stream(packets, payload)

    def _make_connection(self, version: MQTTProtocolVersion) -> BrokerConnection:
        return BrokerConnection(
            self._broker,
            version,
            identifier=self._identifier,
            will=self._make_will(),
            on_completed=self._outbox.published,
            on_writable=self._outbox.pump_soon,
            on_message=self._received,
            on_denied=self._denied_by_broker,
            times=self._times,
        )

    async def _serve(self, client: BrokerConnection) -> None:
        self._client = client
        self._connections += 1
        self._outbox.connected(client)
        for subscription in self._subscriptions:
            client.subscribe(
                subscription.topic_filter, subscription.qos, retain_as_published=subscription.retain_as_published
            )
        self._on_connected(self._connections)
        self._outbox.republish()
        try:
            await asyncio.wait([client.lost])
        finally:
            self._client = None
            self._outbox.disconnected()

    def _received(self, message: Incoming) -> None:
        for subscription in self._subscriptions:
            if subscription.matches(message.topic):
                try:
                    subscription.handle(message)
                except Exception as error:  # a message of any sender must not end the process
                    kind = (subscription.topic_filter, type(error))
                    if kind not in self._defects:
                        self._defects.add(kind)
                        log.exception("a message on %s failed; further such failures are not logged", message.topic)

    def _denied_by_broker(self, topic_filter: str, reason: str) -> None:
        """Log a denied subscription once, not with each new connection."""
        if topic_filter not in self._denied:
            self._denied.add(topic_filter)
            log.warning("broker denies %s (%s): no messages are received there", topic_filter, reason)
