"""What the tests of publishing share: a scripted broker, and a publisher that must account for everything."""

import asyncio
import hashlib
import math
from base64 import b64encode
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from brokers import Amqtt, Mosquitto
from observer import Observer, observe
from observer import until as until
from sample_messages import HEADER as HEADER
from sample_messages import Messages as Messages

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import ConnectionTimes
from resonator_daemon.mqtt.codec import Outgoing, encode
from resonator_daemon.mqtt.publisher import Publisher, Subscription
from resonator_daemon.mqtt.topics import CONTACT_EVENT, STATE_DAEMON

LEFT = "resonator/left"  # base of the topics of the plate "left"
EVENTS = f"{LEFT}/contacts/event"
IMPATIENT = ConnectionTimes(connect_s=0.5, progress_s=0.3, check_s=0.1, close_s=0.1)
QUICK = ConnectionTimes(first_pause_s=0.02, longest_pause_s=0.02, refused_pause_s=0.02, connect_s=0.2)


@dataclass(frozen=True)
class Published:
    """A PUBLISH packet as it came over the wire."""

    qos: int
    retain: bool
    topic: str
    properties: bytes
    payload: bytes


class ScriptedBroker:
    """Just enough of MQTT 5 to accept a connection and to answer each QoS 1 message as told, or not at all."""

    def __init__(self) -> None:
        self.received: list[Published] = []
        self.answer: Callable[[int], int | None] = lambda number: 0  # reason code of the n-th QoS 1 message
        self.connack = b""  # its properties
        self.subscribed = 1  # reason code of each subscription: granted, QoS 1
        self.connections: list[asyncio.StreamWriter] = []
        self.greetings: list[bytes] = []  # bodies of CONNECT
        self.farewells = 0  # DISCONNECT packets
        self.mute = False

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections.append(writer)
        with suppress(asyncio.IncompleteReadError, ConnectionError):
            while not self.mute:
                kind, body = await self._packet(reader)
                if kind >> 4 == 1:
                    self.greetings.append(body)
                    length = len(self.connack)
                    writer.write(bytes((0x20, 3 + length, 0, 0, length)) + self.connack)
                elif kind >> 4 == 3:
                    self._publish(kind, body, writer)
                elif kind >> 4 == 8:
                    writer.write(b"\x90\x04" + body[:2] + b"\x00" + bytes([self.subscribed]))
                elif kind >> 4 == 12:
                    writer.write(b"\xd0\x00")
                elif kind >> 4 == 14:
                    self.farewells += 1
                    break
            await reader.read()  # a mute broker: until the client gives up
        writer.close()

    def hang_up(self) -> None:
        for writer in self.connections:
            writer.transport.abort()

    def _publish(self, kind: int, body: bytes, writer: asyncio.StreamWriter) -> None:
        qos = kind >> 1 & 3
        topic_end = 2 + int.from_bytes(body[:2], "big")
        start = topic_end + 2 * qos + 1  # after a packet id with QoS 1, and the length of the properties, below 128
        end = start + body[start - 1]
        topic = body[2:topic_end].decode()
        self.received.append(Published(qos, bool(kind & 1), topic, body[start:end], body[end:]))
        if qos:
            reason = self.answer(sum(message.qos for message in self.received))
            if reason is not None:
                writer.write(b"\x40\x03" + body[topic_end : topic_end + 2] + bytes([reason]))

    @staticmethod
    async def _packet(reader: asyncio.StreamReader) -> tuple[int, bytes]:
        kind = (await reader.readexactly(1))[0]
        length = shift = 0
        while True:
            byte = (await reader.readexactly(1))[0]
            length |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return kind, await reader.readexactly(length)


@asynccontextmanager
async def scripted_broker() -> AsyncIterator[tuple[str, ScriptedBroker]]:
    script = ScriptedBroker()
    server = await asyncio.start_server(script.serve, "127.0.0.1", 0)
    yield f"mqtt://127.0.0.1:{server.sockets[0].getsockname()[1]}", script
    server.close()
    script.hang_up()
    for writer in script.connections:
        with suppress(ConnectionError):
            await writer.wait_closed()


def make_will() -> Outgoing:
    return Outgoing(f"{LEFT}/state/daemon", encode(Messages.state("offline", "connection lost")), retained=True)


@asynccontextmanager
async def publishing(
    url: str,
    *,
    spool_directory: Path | None = None,
    boot_id: str | None = None,
    subscriptions: tuple[Subscription, ...] = (),
    on_connected: Callable[[int], None] = lambda number: None,
    stream_wait_max_s: float = math.inf,
    times: ConnectionTimes | None = None,
) -> AsyncIterator[Publisher]:
    """A running publisher of the plate "left"; closed at the end, when nothing but what is on disk still waits."""
    publisher = Publisher(
        Mqtt(url=url),
        identifier="left",
        make_will=make_will,
        subscriptions=subscriptions,
        spool_directory=spool_directory,
        boot_id=boot_id,
        on_connected=on_connected,
        stream_wait_max_s=stream_wait_max_s,
        times=times,
    )
    running = asyncio.create_task(publisher.run())
    yield publisher
    await publisher.close((LEFT, STATE_DAEMON, Messages.state("offline", "stopped")))
    await running
    assert_exact(publisher)
    assert publisher.account.waiting == publisher.account.spooled


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the lines of the log without the broker that they begin with."""
    return [record.getMessage().partition(": ")[2] for record in caplog.records]


def assert_exact(publisher: Publisher) -> None:
    account = publisher.account
    assert account.enqueued == (
        account.acknowledged
        + account.written
        + sum(account.dropped.values())
        + account.unknown_at_disconnect
        + account.waiting
    )
    assert 0 <= account.spooled <= account.waiting
    assert publisher.counts.late == account.dropped.get("late", 0)
    not_missed = sum(account.dropped.get(cause, 0) for cause in ("superseded", "late", "not_connected_yet"))
    assert publisher.counts.missed == sum(account.dropped.values()) - not_missed


async def happen(left: Publisher, numbers: range) -> None:
    """Publish events, with an account that is right after each of them."""
    for number in numbers:
        left.publish(LEFT, CONTACT_EVENT, Messages.event(number))
        assert_exact(left)
        if number % 50 == 49:
            await asyncio.sleep(0.001)


async def received_events(observer: Observer, last: int) -> list[dict[str, Any]]:
    """Wait for the last event; return all, doubles of those that were sent before passed over as a subscriber does."""
    await observer.until_last(EVENTS, seq=last)
    seen: dict[int, dict[str, Any]] = {}
    for event in observer.payloads(EVENTS):
        assert event["replayed"] or event["seq"] not in seen
        seen.setdefault(event["seq"], event)
    return list(seen.values())


async def delivered(url: str, left: Publisher, last: int) -> list[dict[str, Any]]:
    """Return what a new subscriber receives up to the last event, after which none waits."""
    async with observe(url) as observer:
        events = await received_events(observer, last)
        await until(lambda: left.account.waiting == 0)
    return events


async def outage(broker: Mosquitto | Amqtt, left: Publisher, numbers: range) -> None:
    """Kill the broker; publish events that are then on disk."""
    await broker.kill()
    await until(lambda: not left.connected)
    await happen(left, numbers)
    await until(lambda: left.account.spooled == len(numbers))


def password_line(name: str, password: str) -> str:
    """As mosquitto_passwd writes it: PBKDF2 with SHA-512."""
    salt = b"twelve bytes"
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, 101)
    return f"{name}:$7$101${b64encode(salt).decode()}${b64encode(digest).decode()}\n"
