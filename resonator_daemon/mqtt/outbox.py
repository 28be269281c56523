"""What waits for the broker, in the order of its priority: states, events, answers, streams."""

import asyncio
import logging
from collections import deque
from itertools import chain
from pathlib import Path
from time import monotonic
from typing import Final, Generic, NamedTuple, TypeVar

from resonator_daemon.mqtt.broker_connection import FAILURE, MQTT_5, NO_SUBSCRIBERS, BrokerConnection, InFlight
from resonator_daemon.mqtt.event_log import Event, EventLog
from resonator_daemon.mqtt.message_account import Account, Cause
from resonator_daemon.mqtt.packets import Packet, StreamPackets, properties_of
from resonator_daemon.mqtt.payloads import ContactEvent
from resonator_daemon.mqtt.topics import CONTACT_EVENT

STREAMS_WAITING_MAX: Final = 4096
STREAM_BYTES_WAITING_MAX: Final = 32 * 2**20
ANSWERS_WAITING_MAX: Final = 32
ANSWER_BYTES_WAITING_MAX: Final = 4 * 2**20
UNACKNOWLEDGED_MAX: Final = 10  # below every broker's usual limit of 20

_TOGETHER: Final = 32  # writes before other tasks of the event loop run
_HEADER_BYTES: Final = 5 + 2 + 2  # of a packet of QoS 1 at most: its type and length, length of the topic, identifier
_SEND_BYTES: Final = 64 * 1024  # of streams in one write

log = logging.getLogger(__name__)


class _Stream(NamedTuple):
    """A message of QoS 0, packed for the wire."""

    topic: str
    packet: bytes
    size_bytes: int
    since_s: float


WaitingT = TypeVar("WaitingT", Packet, _Stream)


class BoundedQueue(Generic[WaitingT]):
    """First in, first out; if an item exceeds the bounds, the oldest items are removed; the new item is always added.

    `items` are in their order, to be looked at only.
    """

    def __init__(self, count_max: int, bytes_max: int) -> None:
        self._count_max = count_max
        self._bytes_max = bytes_max
        self.items: deque[WaitingT] = deque()
        self.size_bytes = 0

    def put(self, item: WaitingT) -> list[WaitingT]:
        """Append an item; return those that had to go for it, the oldest first."""
        pushed_out = []
        while self.items and (
            len(self.items) >= self._count_max or self.size_bytes + item.size_bytes > self._bytes_max
        ):
            pushed_out += self.pop(1)
        self.items.append(item)
        self.size_bytes += item.size_bytes
        return pushed_out

    def pop(self, count: int) -> list[WaitingT]:
        """Remove and return the oldest items, as many as there are."""
        popped: list[WaitingT] = []
        while self.items and len(popped) < count:
            item = self.items.popleft()
            self.size_bytes -= item.size_bytes
            popped.append(item)
        return popped


class Outbox:
    """Sends while the socket takes it, and keeps what it does not take, by the rules of each kind.

    Messages are already counted as enqueued; each is then in exactly one counter, or in `waiting`. As a context
    manager it sends what is put within the context at its end, not in the next iteration of the event loop.

    Parameters
    ----------
    account
        Takes what becomes of each message.
    spool_directory
        Where events wait; None: in memory alone.
    boot_id
        Of this run of the daemon, whose events are stored; None: they are not.

    Attributes
    ----------
    stream_wait_max_s
        How long a perishable stream may wait for the socket, in seconds; older ones are skipped.
    """

    def __init__(
        self,
        account: Account,
        spool_directory: Path | None,
        stream_wait_max_s: float,
        *,
        boot_id: str | None = None,
    ) -> None:
        self._account = account
        self._client: BrokerConnection | None = None
        self._retained: dict[str, Packet] = {}  # last messages by topic
        self._states: dict[str, Packet] = {}  # those of them that wait, in the order in which they are sent
        self.events = EventLog(account, spool_directory, self.pump_soon, boot_id=boot_id)
        self._answers: BoundedQueue[Packet] = BoundedQueue(ANSWERS_WAITING_MAX, ANSWER_BYTES_WAITING_MAX)
        self._streams: BoundedQueue[_Stream] = BoundedQueue(STREAMS_WAITING_MAX, STREAM_BYTES_WAITING_MAX)
        self._reports: BoundedQueue[_Stream] = BoundedQueue(STREAMS_WAITING_MAX, STREAM_BYTES_WAITING_MAX)
        self.stream_wait_max_s = stream_wait_max_s
        self._too_large: set[str] = set()  # topics of which it was logged
        self._pumping = False
        self._moved = asyncio.Event()

    @property
    def queued(self) -> int:
        streams = len(self._reports.items) + len(self._streams.items)
        return len(self._states) + self.events.waiting + len(self._answers.items) + streams

    @property
    def waiting(self) -> int:
        return self.queued + (self._client.messages_in_flight if self._client is not None else 0)

    async def all_sent(self) -> None:
        while self.waiting:
            self._moved.clear()
            await self._moved.wait()

    def put_retained(self, packet: Packet) -> None:
        """Queue the last message of a topic, instead of one that waits."""
        if packet.topic in self._states:
            self._account.drop(Cause.SUPERSEDED, packet.topic)
        self._retained[packet.topic] = self._states[packet.topic] = packet
        self.pump_soon()

    def republish(self) -> None:
        """Send the last message of each retained topic again."""
        again = {topic: packet for topic, packet in self._retained.items() if topic not in self._states}
        self._account.enqueued += len(again)
        self._account.republished += len(again)
        self._states.update(again)
        self.pump_soon()

    def drop_states(self) -> None:
        """Drop the states that still wait at the end."""
        for topic in self._states:
            self._account.drop(Cause.CLOSED, topic)
        self._states.clear()

    def put_event(self, topic: str, message: ContactEvent) -> None:
        self.events.put(topic, message)
        self.pump_soon()

    def put_answer(self, packet: Packet) -> None:
        for pushed_out in self._answers.put(packet):
            self._account.drop(Cause.QUEUE_FULL, pushed_out.topic)
        self.pump_soon()

    def put_stream(self, packets: StreamPackets, payload: bytes) -> None:
        """Queue a message of QoS 0; a perishable one is skipped if it has waited too long."""
        client = self._client
        if client is None:
            self._account.drop(Cause.NO_CONNECTION, packets.topic)
            return
        packet = packets.packet(payload, is_mqtt_5=client.version is MQTT_5)
        size_bytes = len(packet)
        if size_bytes > client.packet_bytes_max:
            self._drop_too_large(packets.topic, size_bytes, client.packet_bytes_max)
            return
        queue = self._streams if packets.perishable else self._reports
        for pushed_out in queue.put(_Stream(packets.topic, packet, size_bytes, monotonic())):
            self._account.drop(Cause.QUEUE_FULL, pushed_out.topic)
        if not self._pumping:
            self.pump_soon()

    def connected(self, client: BrokerConnection) -> None:
        self._client = client
        self.events.connected()

    def disconnected(self) -> None:
        """Account for what was on its way, and drop what is of no use to a later connection."""
        client, self._client = self._client, None
        if client is None:
            return
        self._account.unknown_at_disconnect += client.messages_in_flight
        unknown = [message.token for message in client.in_flight.values()]
        client.in_flight.clear()
        self.events.disconnected([event for event in unknown if isinstance(event, Event)])
        self._drop(self._reports, Cause.NO_CONNECTION)
        self._drop(self._streams, Cause.NO_CONNECTION)
        self._drop(self._answers, Cause.WITHDRAWN)
        self._moved.set()

    def published(self, sent: InFlight, reason_code: int) -> None:
        """Count messages that were written (QoS 0), acknowledged (QoS 1) or refused."""
        token = sent.token
        if reason_code >= FAILURE:
            self._account.drop(Cause.REFUSED, token.topic if isinstance(token, Packet | Event) else "")
        elif sent.qos:
            self._account.acknowledged += 1
        else:
            self._account.written += sent.messages
        if isinstance(token, Event):
            self.events.answered(token, has_subscribers=reason_code != NO_SUBSCRIBERS)
        self._moved.set()
        if self.queued:
            self.pump_soon()

    def __enter__(self) -> None:
        self._pumping = True

    def __exit__(self, *_: object) -> None:
        self._pump()

    def pump_soon(self) -> None:
        if not self._pumping and self._client is not None:
            self._pumping = True
            asyncio.get_running_loop().call_soon(self._pump)

    def _pump(self) -> None:
        """Send while the socket takes it; acknowledged messages first, as they are few, but only some at a time."""
        now_s = monotonic()
        oldest_s = now_s - self.stream_wait_max_s
        while self._streams.items and self._streams.items[0].since_s < oldest_s:  # too late to be of use
            for stream in self._streams.pop(1):
                self._account.drop(Cause.LATE, stream.topic)
            self._moved.set()
        try:
            for _ in range(_TOGETHER):
                client = self._client
                if client is None or not client.writable:
                    return
                if not self._send_next(client) and not self._send_streams(client):
                    return
            asyncio.get_running_loop().call_soon(self.pump_soon)
        finally:
            self._pumping = False

    def _send_next(self, client: BrokerConnection) -> bool:
        """Send one message that is acknowledged, or drop it as too large; False: none can be sent now."""
        if client.unacknowledged >= min(UNACKNOWLEDGED_MAX, client.receive_maximum):
            return False
        if self._states:
            packet = self._states.pop(next(iter(self._states)))
            self._send(client, packet, packet, retain=True)
            return True
        if (event := self.events.pop()) is not None:
            packet = Packet(event.topic, event.payload(late=event.late), properties_of(CONTACT_EVENT))
            if not self._send(client, packet, event):
                self.events.done(event)
            return True
        if self._answers.items:
            (packet,) = self._answers.pop(1)
            self._send(client, packet, packet)
            return True
        return False

    def _send_streams(self, client: BrokerConnection) -> bool:
        """Send the streams that wait, as many as one write should hold; return whether more can be sent now."""
        packets: list[bytes] = []
        size_bytes = 0
        for stream in chain(self._reports.items, self._streams.items):
            packets.append(stream.packet)
            size_bytes += stream.size_bytes
            if size_bytes >= _SEND_BYTES:
                break
        if not packets:
            return False
        begun, complete = client.send_streams(packets)
        sent = self._reports.pop(begun) if self._reports.items else []
        sent += self._streams.pop(begun - len(sent))
        self._account.written += complete
        self._moved.set()
        return complete == len(packets) and bool(self._reports.items or self._streams.items)

    def _send(self, client: BrokerConnection, packet: Packet, token: object, *, retain: bool = False) -> bool:
        """Write a message to the socket; False: it is dropped, the broker would not take it."""
        properties = packet.properties if client.version is MQTT_5 else None
        properties_bytes = len(properties.pack()) if properties is not None else 0
        size_bytes = _HEADER_BYTES + len(packet.topic.encode()) + properties_bytes + len(packet.payload)
        if size_bytes > client.packet_bytes_max:
            self._drop_too_large(packet.topic, size_bytes, client.packet_bytes_max)
            return False
        try:
            client.send(packet.topic, packet.payload, qos=1, retain=retain, properties=properties, token=token)
        except ValueError:  # not a topic that can be published to: of an answer, whose topic others choose
            self._account.drop(Cause.REFUSED, packet.topic)
            return False
        return True

    def _drop_too_large(self, topic: str, size_bytes: int, limit_bytes: int) -> None:
        self._account.drop(Cause.TOO_LARGE, topic)
        self._moved.set()
        if topic not in self._too_large:
            self._too_large.add(topic)
            log.warning(
                "%s: messages of %d bytes are dropped, the broker takes %d; raise its limit",
                topic,
                size_bytes,
                limit_bytes,
            )

    def _drop(self, queue: BoundedQueue[WaitingT], cause: Cause) -> None:
        for packet in queue.pop(len(queue.items)):
            self._account.drop(cause, packet.topic)
