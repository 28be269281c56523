"""What the tests of the decoder process share: frames of a small skin, and a client that keeps what is delivered."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
from decoder_bench import BOOT, NOISE, NU, PITCH_M, SITES, SITES_M, T_NS, E, Floats, pressed, until
from observer import running_task

from resonator_daemon.base.reasons import Reason
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.measure.decoder_process.supervisor import DecoderSupervisor
from resonator_daemon.measure.sensors.surface_requests import SurfaceFrame, SurfaceSettings
from resonator_daemon.mqtt.codec import decode, encode
from resonator_daemon.mqtt.payloads import ContactEvent, Lost, Message
from resonator_daemon.mqtt.topics import HeaderFields, Topic

NOTHING = np.zeros((3, SITES))
SKIN = Skin(HalfSpace(E, NU), SITES_M, 1e-3)


def settings(skin: Skin = SKIN, **options: Any) -> SurfaceSettings:
    return SurfaceSettings(
        skin, DecodingOptions(contact_physics=False), np.arange(100, 100 + SITES), PITCH_M, **options
    )


def header(seq: int) -> HeaderFields:
    return HeaderFields(
        name="hand",
        seq=seq,
        daemon_boot_id=BOOT,
        t_ns=T_NS + seq * 10_000_000,
        t_uncertainty_ns=42_000,
        lost=Lost(link_gap=3),
        board_ticks=1000 + seq,
    )


def frame(seq: int, values: Floats | None = None, noise_std: Floats = NOISE) -> SurfaceFrame:
    """A pressed frame, unless other values are given; `seq` on `contacts` is 1000 more."""
    return SurfaceFrame(header(seq), 1000 + seq, pressed(seq % 40) if values is None else values, noise_std)


class Client:
    """A supervised decoder, and what it has delivered and announced."""

    def __init__(self, **options: Any) -> None:
        self.supervisor = DecoderSupervisor[int](settings(**options), self, "hand")
        self.messages: list[tuple[int, str, Message]] = []
        self.events: list[ContactEvent] = []
        self.announced: list[Reason | None] = []
        self.offered = 0

    def deliver(self, origin: int, topic: Topic[Any], message: Any) -> None:
        self.messages.append((origin, topic.path, decode(topic.payload, encode(message))))

    def deliver_event(self, origin: int, event: ContactEvent) -> None:
        self.events.append(event)

    def announce(self, note: Reason | None) -> None:
        self.announced.append(note)

    def lost(self, _origin: int) -> Lost:
        return Lost(link_gap=3, skipped_late=3 * self.supervisor.frames_late)

    def contacts_header(self, origin: int) -> HeaderFields:
        return header(origin) | {"seq": 5000}  # type: ignore[return-value]

    def on(self, path: str) -> list[Any]:
        return [message for _, topic, message in self.messages if topic == path]

    def offer(self, values: Floats | None = None) -> None:
        self.supervisor.offer(self.offered, frame(self.offered, values))
        self.offered += 1

    async def read(self, values: Floats | None = None) -> None:
        """Offer frames until one more is decoded, and wait for its contacts."""
        before = self.supervisor.decoded
        while self.supervisor.decoded == before:
            self.offer(values)
            async with asyncio.timeout(120):  # a process starts, on a busy computer
                while self.supervisor.waiting:  # noqa: ASYNC110  there is no event for it
                    await asyncio.sleep(0.005)
        await until(lambda: len(self.on("contacts")) >= len(self.on("decoded")))

    async def touch(self) -> None:
        """Offer pressed frames until a contact is there."""
        before = len(self.events)
        while len(self.events) == before:
            await self.read()

    @property
    def is_exact(self) -> bool:
        counts = self.supervisor
        return self.offered == counts.decoded + counts.skipped.total() + counts.waiting

    @asynccontextmanager
    async def running(self) -> AsyncIterator["asyncio.Task[None]"]:
        async with running_task(self.supervisor.run()) as task:
            yield task
        assert self.is_exact
        assert self.supervisor.waiting == 0
        assert self.supervisor.info().pid is None
