"""Followed plates without a broker: the same results as in the daemon or alone, contacts that end, exact accounts."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest
from decoder_bench import NOISE, NU, PITCH_M, SITES_M, E, incoming, info, pressed, signals, until
from observer import running_task

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.board.config.tables import Decoding
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.extensions.remote_decoding import plate
from resonator_daemon.extensions.remote_decoding.plate import RemotePlate, frame_of
from resonator_daemon.measure.decoder_process.supervisor import DecoderSupervisor
from resonator_daemon.measure.sensors.output import LatencyHistogram
from resonator_daemon.measure.sensors.surface_requests import Reply, Results, SurfaceSettings, Work
from resonator_daemon.measure.sensors.surface_worker import SurfaceWorker
from resonator_daemon.mqtt.codec import Encoded, decode, encode
from resonator_daemon.mqtt.payloads import ContactEvent, Info, Message, Signals
from resonator_daemon.mqtt.topics import Topic

SKIN = Skin(HalfSpace(E, NU), SITES_M, 1e-3)
LINEAR = DecodingOptions(contact_physics=False, background=False)
NOTHING = np.zeros((3, len(SITES_M)))


def as_sent(path: str, message: Message | Encoded) -> tuple[str, bytes]:
    if isinstance(message, ContactEvent):  # the publisher numbers events
        message = message.model_copy(update={"seq": 0})
    return path, encode(message)


def alone(frames: list[Signals]) -> list[tuple[str, bytes]]:
    """Topic and payload of each message about a plate that is decoded without others."""
    sent: list[tuple[str, bytes]] = []

    def add(reply: Reply) -> None:
        if isinstance(reply, Results):
            sent.extend(as_sent(*message) for message in reply.messages)

    worker = SurfaceWorker(SurfaceSettings(SKIN, LINEAR, np.arange(100, 244), PITCH_M, "host-1"), add)
    for message in frames:
        worker.serve(Work(frame_of(message), 1 << 62))
    return sent


class Followed:
    """A followed plate, and what it has published."""

    def __init__(self, **options: Any) -> None:
        self.published: list[tuple[str, Message]] = []
        config = DecoderConfig(name="hand", decoding=Decoding(**({"contact_physics": False} | options)))
        self.plate = RemotePlate(config, "hand", "host-1", self._publish, LatencyHistogram())
        self._info, self._signals = self.plate.subscriptions

    def _publish(self, topic: Topic[Any], message: Message | Encoded) -> None:
        if isinstance(message, Encoded):
            message = decode(topic.payload, message.payload)
        self.published.append((topic.path, message))

    def on(self, path: str) -> list[Any]:
        return [message for topic, message in self.published if topic == path]

    async def send_info(self, message: Info) -> None:
        """Send an info; it takes effect with the next turn of the event loop, and frames before that are skipped."""
        self._info.handle(incoming(self._info.topic_filter, encode(message)))
        await asyncio.sleep(0.01)

    async def prepare(self, message: Info) -> None:
        """Send an info, and untouched frames until its decoder is set up; all but events is discarded."""
        await self.send_info(message)
        published, decoded = len(self.published), self.account.decoded
        sites = len(message.sites)
        noise_std = np.tile(NOISE[:, :1], sites).astype(np.float32)
        while self.account.decoded == decoded:
            self.send(signals(0, np.zeros((3, sites)), noise_std=noise_std))
            await asyncio.sleep(0.01)
        await until(lambda: self.account.waiting == 0 and self.published[-1][0] == "contacts")
        self.published[published:] = [each for each in self.published[published:] if each[0] == "contacts/event"]

    def send(self, message: Signals) -> None:
        self._signals.handle(incoming(self._signals.topic_filter, encode(message)))

    async def read(self, message: Signals) -> None:
        """Send a frame until it is decoded, on a busy computer more than once, and wait for its contacts."""
        before = len(self.on("decoded"))
        while len(self.on("decoded")) == before:
            self.send(message)
            await until(lambda: self.account.waiting == 0)
        await until(lambda: len(self.on("decoded/summary")) > before and self.on("contacts")[-1].seq == message.seq)

    @property
    def account(self) -> Any:
        return self.plate.health()

    @property
    def is_exact(self) -> bool:
        account = self.account
        return bool(account.received == account.decoded + account.skipped + account.unusable + account.waiting)

    @asynccontextmanager
    async def running(self) -> AsyncIterator["Followed"]:
        async with running_task(self.plate.run()):
            yield self
        assert self.is_exact
        assert self.account.waiting == 0


async def test_results_are_those_of_the_daemons_own_stage() -> None:
    frames = [signals(seq, pressed(seq)) for seq in range(8)] + [signals(seq, NOTHING) for seq in range(8, 13)]
    async with Followed().running() as followed:
        await followed.prepare(info())
        for frame in frames:
            await followed.read(frame)
    expected = alone([signals(0, NOTHING), *frames])
    events = followed.on("contacts/event")
    for path in ("decoded", "decoded/summary", "contacts", "contacts/event"):
        prepared = 0 if path == "contacts/event" else 1
        sent = [as_sent(path, message) for message in followed.on(path)]
        assert sent == [message for message in expected if message[0] == path][prepared:]
    assert [event.seq for event in events] == list(range(len(events)))
    assert [event.event for event in followed.on("contacts/event")] == ["onset", "release"]


@pytest.mark.parametrize(("uncertainty", "displacement"), [(True, False), (False, True)])
async def test_only_what_is_asked_for_is_published(uncertainty: bool, displacement: bool) -> None:
    async with Followed(displacement=displacement, uncertainty=uncertainty).running() as followed:
        await followed.prepare(info())
        await followed.read(signals(0))
    (found,) = followed.on("decoded")
    assert (found.traction_std_pascal is not None, found.displacement_m is not None) == (uncertainty, displacement)


async def test_a_plate_without_a_skin_and_one_that_cannot_be_decoded_are_distinguished() -> None:
    on_a_line = tuple(site.model_copy(update={"position_m": (1e-4 * i, 0.0)}) for i, site in enumerate(info().sites))
    async with Followed(method="fourier", contact_physics=True).running() as followed:
        await followed.send_info(info(skin=None))
        assert followed.plate.condition()[1].code == "info_unusable"
        await followed.send_info(info(sites=on_a_line, grid=None))
        followed.send(signals(0))
        await until(lambda: followed.plate.condition()[0] == "refused")
        assert followed.plate.condition()[1].code == "undecodable"
        for seq in range(1, 4):  # in vain
            followed.send(signals(seq))
        assert followed.is_exact
        await followed.prepare(info())
        await followed.read(signals(1))
        await until(lambda: followed.plate.condition()[0] == "online")
        followed.plate.announce(contradicted := Reason(ReasonCode.FIT_CONTRADICTED, "of a test"))
        assert followed.plate.condition() == ("online", contradicted)


async def test_another_skin_takes_effect_ends_the_contacts_and_counts_on() -> None:
    async with Followed().running() as followed:
        await followed.prepare(info())
        for seq in range(3):
            await followed.read(signals(seq))
        sites = tuple(site.model_copy(update={"site": site.site + 1000}) for site in info().sites)
        await followed.prepare(info(sites=sites))
        for seq in range(3, 6):
            await followed.read(signals(seq))
    events = followed.on("contacts/event")
    released = [(event.contact.id, event.reason_code) for event in events if event.event == "release"]
    assert released == [(1, "plate_changed"), (2, "stopped")]
    assert [event.contact.id for event in events] == [1, 1, 2, 2]
    assert events[0].contact.site < 1000 < events[2].contact.site
    assert events[1].reason == "the plate has changed"
    assert events[1].contact.since_t_ns == events[0].contact.since_t_ns  # the onset is not forgotten
    assert events[1].contact.duration_s == pytest.approx(0.01)


async def test_contacts_end_when_signals_stop_and_only_then(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plate, "CONTACTS_END_S", 3600.0)
    monkeypatch.setattr(plate, "LOOK_S", 0.01)
    interruptions: list[str] = []
    interrupt = DecoderSupervisor.interrupt
    monkeypatch.setattr(
        DecoderSupervisor, "interrupt", lambda decoder, why: (interruptions.append(why), interrupt(decoder, why))
    )
    async with Followed().running() as followed:
        await followed.prepare(info())
        for seq in range(3):
            await followed.read(signals(seq))
        assert interruptions == []
        monkeypatch.setattr(plate, "CONTACTS_END_S", 0.05)
        await until(lambda: len(followed.on("contacts/event")) == 2)
        await until(lambda: followed.on("contacts")[-1].contacts == ())
        onset, release = followed.on("contacts/event")
        assert (onset.event, onset.reason) == ("onset", None)
        assert (release.event, release.reason) == ("release", "no signals for 0.05 s")
        assert len(followed.on("decoded")) == len(followed.on("decoded/summary")) == 3
        await asyncio.sleep(0.05)  # looked some times more
        assert len(interruptions) == 1
        monkeypatch.setattr(plate, "CONTACTS_END_S", 3600.0)
        for seq in range(3, 5):
            await followed.read(signals(seq))
        assert followed.on("contacts/event")[2].contact.id == 2
