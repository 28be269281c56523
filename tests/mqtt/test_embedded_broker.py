"""The embedded broker: who receives a stream, what a slow subscriber misses, and how it ends."""

import asyncio
import logging
import struct
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

import aiomqtt
import pytest
from mqtt_helpers import until

from resonator_daemon.base.errors import UserError
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.embedded_broker import embedded_broker

CONNECT, CONNACK, PUBLISH, PUBACK, SUBSCRIBE, SUBACK, UNSUBSCRIBE = (0x10, 0x20, 0x30, 0x40, 0x82, 0x90, 0xA2)
DISCONNECT = 0xE0
LARGE = 100_000


class Client:
    """Writes and reads packets of MQTT 3.1.1, byte by byte, and reads only when it is asked to."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    def send(self, kind: int, body: bytes = b"") -> None:
        length, head = len(body), bytearray([kind])
        while True:
            head.append(length % 128 | (128 if length > 127 else 0))
            length //= 128
            if not length:
                break
        self._writer.write(head + body)

    def publish(self, topic: str, payload: bytes, qos: int = 0) -> None:
        self.send(PUBLISH | qos << 1, text(topic) + (b"\0\1" if qos else b"") + payload)

    async def ask(self, kind: int, body: bytes = b"") -> bytes:
        """Send a packet; return the next packet that arrives."""
        self.send(kind, body)
        return (await self.receive())[1]

    async def subscribe(self, topic_filter: str, qos: int = 0) -> None:
        self.send(SUBSCRIBE, b"\0\1" + text(topic_filter) + bytes([qos]))
        assert (await self.receive())[0] == SUBACK

    async def receive(self) -> tuple[int, bytes]:
        """Return the kind and body of the next packet."""
        async with asyncio.timeout(20):
            (kind,) = await self._reader.readexactly(1)
            length = place = 0
            while True:
                (byte,) = await self._reader.readexactly(1)
                length |= (byte & 127) << 7 * place
                place += 1
                if byte < 128:
                    return kind, await self._reader.readexactly(length)

    async def payload(self) -> bytes:
        """Return the payload of the next packet, which is a message of QoS 0."""
        kind, body = await self.receive()
        assert kind == PUBLISH
        return body[2 + int.from_bytes(body[:2], "big") :]


def text(words: str) -> bytes:
    return struct.pack(">H", len(words)) + words.encode()


@asynccontextmanager
async def client(url: str, name: str, *, limit: int = 2**16) -> AsyncIterator[Client]:
    reader, writer = await asyncio.open_connection("127.0.0.1", Mqtt(url=url).port, limit=limit)
    connected = Client(reader, writer)
    connected.send(CONNECT, b"\0\4MQTT\4\2\0\x3c" + text(name))
    assert await connected.receive() == (CONNACK, b"\0\0")
    yield connected
    writer.close()


@pytest.fixture
async def url() -> AsyncIterator[str]:
    async with embedded_broker() as url:
        yield url


async def test_a_message_goes_once_to_each_whose_filter_it_matches(url: str) -> None:
    async with client(url, "one") as one, client(url, "other") as other, client(url, "sender") as sender:
        await one.subscribe("a/+")
        await one.subscribe("a/#")
        await other.subscribe("b")
        for topic in ("a/1", "b", "a/2"):
            sender.publish(topic, topic.encode())
        assert [await one.payload(), await one.payload()] == [b"a/1", b"a/2"]
        assert await other.payload() == b"b"
        one.send(UNSUBSCRIBE, b"\0\2" + text("a/#"))
        await one.receive()
        await one.subscribe("c")
        for topic in ("a/3", "c"):
            sender.publish(topic, topic.encode())
        assert [await one.payload(), await one.payload()] == [b"a/3", b"c"]


async def test_a_slow_subscriber_misses_streams_and_no_event(url: str) -> None:
    async with client(url, "slow", limit=1024) as slow, client(url, "sender") as sender:
        await slow.subscribe("stream")
        await slow.subscribe("event", qos=1)
        async with client(url, "quick") as quick:
            await quick.subscribe("stream")
            for number in range(200):  # 20 MB, far more than sockets hold
                sender.publish("stream", struct.pack(">I", number) + bytes(LARGE))
                assert (await quick.payload())[:4] == struct.pack(">I", number)
        assert await sender.ask(PUBLISH | 2, text("event") + b"\0\1happened") == b"\0\1"
        numbers = []
        while (packet := await slow.receive())[0] == PUBLISH:
            numbers.append(struct.unpack(">I", packet[1][8:12])[0])
        assert packet[1].endswith(b"happened")
        assert numbers == list(range(len(numbers)))
        assert 0 < len(numbers) < 200
        slow.send(PUBACK, packet[1][7:9])
        sender.publish("stream", b"next")
        assert await slow.payload() == b"next"


async def test_what_a_client_sent_before_it_disconnected_reaches_the_subscribers(url: str) -> None:
    count = 100
    async with client(url, "reader") as reader:
        await reader.subscribe("event")
        async with client(url, "sender") as sender:
            for number in range(count):
                sender.send(PUBLISH | 2, text("event") + struct.pack(">HI", number + 1, number))
            for number in range(count):
                assert await sender.receive() == (PUBACK, struct.pack(">H", number + 1))
            sender.send(DISCONNECT)
        numbers = [struct.unpack(">I", await reader.payload())[0] for _ in range(count)]
    assert numbers == list(range(count))


async def test_it_is_quiet_and_stops_at_once_with_clients_connected(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    async with AsyncExitStack() as stack:
        url = await stack.enter_async_context(embedded_broker())
        client = aiomqtt.Client("127.0.0.1", Mqtt(url=url).port)
        await client.__aenter__()
        await client.publish("a", b"1", qos=1)
        async with asyncio.timeout(1):
            await stack.aclose()
    await until(lambda: client._disconnected.done())
    assert client._disconnected.exception() is not None
    assert [record for record in caplog.records if record.name.startswith(("amqtt", "transitions"))] == []
    with pytest.raises(aiomqtt.MqttError, match="refused"):
        await aiomqtt.Client("127.0.0.1", Mqtt(url=url).port).__aenter__()


async def test_what_to_install_where_amqtt_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "amqtt.broker", None)
    with pytest.raises(UserError, match=r"python\S* -m pip install amqtt"):
        async with embedded_broker():
            pass
