"""What the tests of publishing share: messages, a scripted broker, and a publisher that must account for everything."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.payloads import (
    Compensation,
    Decoded,
    EventContact,
    Forces,
    Lost,
    SiteForce,
    State,
)
from resonator_daemon.publishing.payloads import ContactEvent as Event
from resonator_daemon.publishing.publisher import Publisher

HEADER: dict[str, Any] = {
    "seq": 1234,
    "daemon_boot_id": "9f3c",
    "board_boot_id": "51aa",
    "t_ns": 1789000000000000000,
    "t_unc_ns": 42000,
    "lost": Lost(),
}
COMPENSATION = Compensation(
    baseline="followed",
    common_mode=(3e-6,) * 4,
    common_mode_std=2e-7,
    plate_kelvin=0.5,
    plate_kelvin_std=0.1,
    response="off",
)


class Messages:
    """Makes messages that differ by one number."""

    @staticmethod
    def state(word: str, reason: str = "") -> State:
        return State(**HEADER, state=word, reason=reason, since_t_ns=1788999990000000000)

    @staticmethod
    def forces(number: int) -> Forces:
        site = SiteForce(site=7, force_newton=1.234, noise_newton=0.0006, systematic_newton=0.012, status="ok")
        return Forces(
            **HEADER | {"seq": number},
            board_ticks=1,
            window_s=0.01,
            status="ok",
            reason="",
            sites=(site,),
            beats=(),
            compensation=COMPENSATION,
        )

    @staticmethod
    def event(number: int) -> Event:
        contact = EventContact(
            id=number,
            site=7,
            position_m=(0.0012, -0.0034),
            position_std_m=(2e-4, 2e-4),
            position_correlation=0.0,
            force_newton=1.234,
            noise_newton=0.0006,
            systematic_newton=0.012,
            peak_newton=1.3,
            since_t_ns=1788999990000000000,
            duration_s=0.35,
            status="ok",
        )
        return Event(**HEADER | {"seq": number}, board_ticks=1, event="onset", contact=contact)

    @staticmethod
    def decoded(number: int) -> Decoded:
        array = np.full((3, 32, 32), number, np.float32)
        return Decoded(
            **HEADER | {"seq": number},
            board_ticks=1,
            traction_pascal=array,
            traction_std_pascal=array,
            displacement_m=None,
            grid=None,
        )


@dataclass(frozen=True)
class Published:
    """A PUBLISH packet as it came over the wire."""

    qos: int
    retain: bool
    topic: str
    payload: bytes


class ScriptedBroker:
    """Just enough of MQTT 5 to accept a connection and to answer each QoS 1 message as told, or not at all."""

    def __init__(self) -> None:
        self.received: list[Published] = []
        self.answer: Callable[[int], int | None] = lambda number: 0  # reason code of the n-th QoS 1 message
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
                    writer.write(b"\x20\x03\x00\x00\x00")
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
        properties_end = topic_end + 2 * qos + 1  # a packet id with QoS 1, and the length of no properties
        self.received.append(Published(qos, bool(kind & 1), body[2:topic_end].decode(), body[properties_end:]))
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


@asynccontextmanager
async def publishing(url: str) -> AsyncIterator[Publisher]:
    """A running publisher of the plate "left"; closed at the end."""
    publisher = Publisher(Mqtt(url=url), "left", lambda reason: Messages.state("offline", reason))
    running = asyncio.create_task(publisher.run())
    yield publisher
    await publisher.close()
    await running
    assert_exact(publisher)
    assert publisher.account.waiting == 0


async def until(predicate: Callable[[], bool]) -> None:
    """Look again with each turn of the event loop, for 20 s at most."""
    async with asyncio.timeout(20):
        while not predicate():  # noqa: ASYNC110  there is no event for every condition
            await asyncio.sleep(0.005)


def assert_exact(publisher: Publisher) -> None:
    account = publisher.account
    assert account.made == (
        account.acknowledged
        + account.handed_to_socket
        + account.dropped
        + account.unknown_at_disconnect
        + account.waiting
    )
