"""A small MQTT 3.1.1 broker on the loopback interface, for the demo: in this process, or run as a module."""

import asyncio
import contextlib
import logging
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final

from paho.mqtt.client import topic_matches_sub

from resonator_daemon.base.errors import MissingLibraryError
from resonator_daemon.base.host.text import how_to_install

if TYPE_CHECKING:
    from amqtt.broker import Broker

WAITING_BYTES_MAX: Final = 256 * 1024  # for one subscriber: ten decoded frames, a few hundred messages of forces
UNREAD_BYTES_MAX: Final = 256 * 1024  # of one client, which amqtt has not read yet; then the socket is not read
TOPICS_MAX: Final = 1024  # whose subscribers are remembered

_READ_BYTES: Final = 64 * 1024
_STREAM: Final = 0x30  # PUBLISH with QoS 0, neither retained nor a duplicate
_DISCONNECT: Final = b"\xe0\x00"
_CONNACK, _SUBACK, _UNSUBACK = b"\x20", b"\x90", b"\xb0"
_LENGTH_BYTES_MAX: Final = 4
_DELIVERY_S: Final = 5.0  # at most, for messages of a client that has disconnected
_DELIVERY_CHECK_S: Final = 0.001

log = logging.getLogger(__name__)


class StreamDelivery:
    """Delivery of messages of QoS 0 that are not retained to their subscribers; amqtt handles all others.

    Those for a subscriber that has too many bytes waiting are dropped, and counted in `dropped`. They may overtake
    messages of QoS 1: MQTT keeps the order within one topic and QoS alone (MQTT 3.1.1, section 4.6).
    """

    def __init__(self, broker: "Broker") -> None:
        self._broker = broker
        self._subscribers: dict[bytes, list[Connection]] = {}  # by topic
        self.dropped = 0

    def forward(self, packet: bytes, topic: bytes) -> None:
        """Write a packet to all subscribers of its topic."""
        subscribers = self._subscribers.get(topic)
        if subscribers is None:
            if len(self._subscribers) >= TOPICS_MAX:
                self._subscribers.clear()
            subscribers = self._subscribers[topic] = self._find(topic.decode(errors="replace"))
        for subscriber in subscribers:
            if not subscriber.write_stream(packet):
                if not self.dropped:
                    log.warning("a subscriber does not keep up: it misses messages of QoS 0")
                self.dropped += 1

    def subscriptions_changed(self) -> None:
        self._subscribers.clear()

    def undelivered(self, sender: "Connection") -> int:
        """Return how many messages of a client amqtt has acknowledged, but not passed to their subscribers yet."""
        sessions = self._broker.sessions.values()
        return sum(session.delivered_message_queue.qsize() for session, handler in sessions if handler.writer is sender)

    def _find(self, topic: str) -> list["Connection"]:
        identifiers = {
            session.client_id
            for topic_filter, subscriptions in self._broker.subscriptions.items()
            if topic_matches_sub(topic_filter, topic)
            for session, _ in subscriptions
        }
        handlers = [self._broker.sessions[each][1] for each in identifiers if each in self._broker.sessions]
        return [handler.writer for handler in handlers if isinstance(handler.writer, Connection)]


class PacketReader:
    """Packets for amqtt, at most 256 kB ahead of it.

    The methods without a comment are those of amqtt's ReaderAdapter.
    """

    def __init__(self) -> None:
        self._reader = asyncio.StreamReader()
        self.unread_bytes = 0
        self._read = asyncio.Event()
        self._ended = False

    async def feed(self, data: bytes) -> None:
        """Append packets; wait until little enough is unread."""
        self._reader.feed_data(data)
        self.unread_bytes += len(data)
        while self.unread_bytes > UNREAD_BYTES_MAX and not self._ended:
            self._read.clear()
            await self._read.wait()

    async def read(self, n: int = -1) -> bytes:
        data = await (self._reader.read() if n == -1 else self._reader.readexactly(n))
        self.unread_bytes -= len(data)
        self._read.set()
        return data

    def feed_eof(self) -> None:
        self._ended = True
        self._read.set()
        self._reader.feed_eof()


class Connection:
    """One client: `read_on` sorts its packets; amqtt reads those left for it from `reader`, and writes to this object.

    The methods without a comment are those of amqtt's WriterAdapter.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, delivery: StreamDelivery) -> None:
        self._socket_reader = reader
        self._writer = writer
        self._delivery = delivery
        self._accepted = False
        self._closed = False
        self.reader = PacketReader()

    async def read_on(self) -> None:
        """Read until the client disconnects; amqtt is informed after it has delivered the client's messages.

        With the end of a connection amqtt discards those that it has acknowledged and not delivered yet.
        """
        try:
            farewell = await self._read_packets()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_DELIVERY_S):
                    await self._wait_for_amqtt()
                    await self.reader.feed(farewell)
                    await self._wait_for_amqtt()  # which else takes the end of the bytes for a lost connection
        finally:
            self.reader.feed_eof()

    async def _wait_for_amqtt(self) -> None:
        """Wait until amqtt has read all packets and passed on their messages."""
        await asyncio.sleep(_DELIVERY_CHECK_S)
        while self.reader.unread_bytes or self._delivery.undelivered(self):  # noqa: ASYNC110 - no event
            await asyncio.sleep(_DELIVERY_CHECK_S)

    async def _read_packets(self) -> bytes:
        """Pass on packets until the client disconnects; return its DISCONNECT packet, empty where there was none."""
        waiting = bytearray()
        with contextlib.suppress(OSError):
            while data := await self._socket_reader.read(_READ_BYTES):
                waiting += data
                used_bytes, packets = self._sort(bytes(waiting))
                del waiting[:used_bytes]
                if packets:
                    await self.reader.feed(packets)
                if waiting[:1] == _DISCONNECT[:1]:
                    return _DISCONNECT
        return b""

    def write_stream(self, packet: bytes) -> bool:
        """Write a packet unless too much waits already; return whether it was written."""
        if self._closed or self._writer.transport.get_write_buffer_size() > WAITING_BYTES_MAX:
            return self._closed
        self._writer.write(packet)
        return True

    def write(self, data: bytes) -> None:
        if data[:1] == _CONNACK:
            self._accepted = data[3] == 0
        elif data[:1] in (_SUBACK, _UNSUBACK):
            self._delivery.subscriptions_changed()
        if not self._closed:
            self._writer.write(data)

    async def drain(self) -> None:
        if not self._closed:
            await self._writer.drain()

    def get_peer_info(self) -> tuple[str, int] | None:
        name = self._writer.get_extra_info("peername")
        return (name[0], name[1]) if name else None

    def get_ssl_info(self) -> None:
        return None

    async def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._delivery.subscriptions_changed()
            self._writer.close()

    def _sort(self, data: bytes) -> tuple[int, bytes]:
        """Forward the packets of streams up to DISCONNECT; return the number of bytes read, and the others of them."""
        start, others = 0, bytearray()
        while data[start : start + 1] != _DISCONNECT[:1] and (ends := packet_ends(data, start)) is not None:
            body, end = ends
            if data[start] == _STREAM and self._accepted:
                topic_end = body + 2 + int.from_bytes(data[body : body + 2], "big")
                self._delivery.forward(data[start:end], data[body + 2 : topic_end])
            else:
                others += data[start:end]
            start = end
        return start, bytes(others)


def packet_ends(data: bytes, start: int) -> tuple[int, int] | None:
    """Return where the body of the packet at `start` begins and ends; None where it is not whole yet."""
    length = 0
    for place in range(_LENGTH_BYTES_MAX):
        at = start + 1 + place
        if at >= len(data):
            return None
        length |= (data[at] & 0x7F) << 7 * place
        if data[at] < 0x80:
            break
    end = at + 1 + length
    return (at + 1, end) if end <= len(data) else None


SHUTDOWN_TIMEOUT_S: Final = 2.0


@asynccontextmanager
async def embedded_broker(port: int = 0) -> AsyncIterator[str]:
    """Serve anonymous clients as long as the context lasts; yield the broker's URL, on a free port unless one is given.

    Raises
    ------
    UserError
        amqtt, which the broker is made of, is not installed.
    """
    try:
        from amqtt.broker import Broker
    except ImportError as error:
        raise MissingLibraryError(f"the embedded broker needs amqtt: {how_to_install('amqtt')}") from error

    for name in ("amqtt", "transitions"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    # The listener is ours, not amqtt's, so that the port is known without choosing it beforehand.
    config = {
        "listeners": {"default": {"type": "external"}},
        "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
    }
    broker = Broker(config)
    delivery = StreamDelivery(broker)
    serving: dict[asyncio.Task[None], asyncio.StreamWriter] = {}

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connection = Connection(reader, writer, delivery)
        reading = asyncio.create_task(connection.read_on())
        try:
            await broker.external_connected(connection.reader, connection, "default")
        finally:
            reading.cancel()
            writer.close()
            delivery.subscriptions_changed()

    def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.create_task(serve(reader, writer))
        serving[task] = writer
        task.add_done_callback(serving.pop)

    await broker.start()
    server = await asyncio.start_server(accept, "127.0.0.1", port)
    try:
        yield f"mqtt://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        # Connections first: amqtt's own shutdown cancels their readers, which do not always take notice.
        for writer in serving.values():
            writer.transport.abort()
        if serving:
            await asyncio.wait(serving, timeout=SHUTDOWN_TIMEOUT_S)
        await broker.shutdown()


async def _serve_until_stopped() -> None:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with embedded_broker() as url:
        sys.stdout.write(url + "\n")
        sys.stdout.flush()
        await stop.wait()


if __name__ == "__main__":
    asyncio.run(_serve_until_stopped())
