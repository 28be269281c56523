"""Plates that one thread follows: each as if alone, with matrices built once, whatever becomes of the others."""

import asyncio
from typing import Any

import numpy as np
import pytest
from decoder_bench import NOISE, NU, SITES_M, E, incoming, info, pressed, signals, until

from resonator_daemon.config.decoder import DecoderConfig
from resonator_daemon.config.tables import Decoding
from resonator_daemon.decoding import equal_skins
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.elastic import HalfSpace
from resonator_daemon.publishing.codec import Encoded, encode
from resonator_daemon.publishing.payloads import ContactEvent, Message
from resonator_daemon.publishing.topics import Topic
from resonator_daemon.remote_decoding import followed_plate, thread_decoding
from resonator_daemon.remote_decoding.followed_plates import FollowedPlates
from resonator_daemon.remote_decoding.plate import header_of
from resonator_daemon.sensors.surface_stream import SurfaceFrame, SurfaceSettings, SurfaceStream

OPTIONS = DecodingOptions(background=False)
SETTINGS = SurfaceSettings(Skin(HalfSpace(E, NU), SITES_M, 1e-3), OPTIONS, np.arange(100, 244), 4e-4, "host-1")
UNTOUCHED = signals(0, np.zeros_like(NOISE))
FRAMES = {
    "left": [signals(seq, pressed(seq)) for seq in range(1, 6)] + [signals(seq, pressed(90)) for seq in (6, 7)],
    "right": [signals(1, pressed(30)), *(signals(seq, pressed(60 - 4 * seq, 0.6)) for seq in range(2, 8))],
}
FRAMES["right"][3].signals[1, 40] = np.nan  # a lost signal has a state of its own


def as_sent(topic: Topic[Any], message: Message | Encoded) -> tuple[str, bytes]:
    if isinstance(message, ContactEvent):  # events are numbered by whoever publishes them
        message = message.model_copy(update={"seq": 0})
    return topic.path, message.payload if isinstance(message, Encoded) else encode(message)


def alone(plate: str) -> list[tuple[str, bytes]]:
    """Topic and payload of each message about a plate that is decoded without others."""
    sent: list[tuple[str, bytes]] = []
    stream = SurfaceStream(SETTINGS, lambda *message: sent.append(as_sent(*message)), [].append)
    for message in FRAMES[plate]:
        frame = SurfaceFrame(header_of(message), message.seq, message.signals.astype(float), NOISE)
        stream.prepare(frame)
        stream.decode(frame)
    return sent


async def test_each_plate_is_decoded_as_if_alone_with_matrices_built_once(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = {plate: alone(plate) for plate in FRAMES}
    built: list[int] = []
    set_up = equal_skins.set_up
    monkeypatch.setattr(equal_skins, "set_up", lambda skin, *rest: (built.append(1), set_up(skin, *rest))[1])
    monkeypatch.setattr(thread_decoding, "AGE_MAX_NS", 10**11)  # both for busy computers
    monkeypatch.setattr(followed_plate, "CONTACTS_END_S", 3600.0)
    sent: dict[str, list[tuple[str, bytes]]] = {"left": [], "right": [], "point": []}
    config = DecoderConfig(decoding=Decoding(plates=tuple(sent)))
    plates = FollowedPlates(config, OPTIONS, "host-1", lambda plate, *message: sent[plate].append(as_sent(*message)))
    handlers = {subscription.topic_filter: subscription.handle for subscription in plates.subscriptions}

    def send(plate: str, path: str, message: Message) -> None:
        topic = f"resonator/{plate}/{path}"
        handlers[topic](incoming(topic, encode(message)))

    async def decoded(frames: int) -> None:
        """Wait until so many frames of both plates have their last message."""
        await until(lambda: all([path for path, _ in sent[p]].count("contacts") == frames for p in FRAMES))

    at_one_point = tuple(site.model_copy(update={"position_m": (0.0, 0.0)}) for site in info().sites)
    running = asyncio.create_task(plates.run())
    for plate in sent:
        send(plate, "info", info(sites=at_one_point, grid=None) if plate == "point" else info())
    await asyncio.sleep(0)  # an info takes effect
    await asyncio.sleep(0)
    for plate in sent:
        send(plate, "signals", UNTOUCHED)
    await decoded(1)
    await until(lambda: "nothing is decoded" in plates.condition()[1].text)
    assert (plates.condition()[0], len(built)) == ("online", 2)  # one for the plate that cannot be decoded
    for messages in sent.values():
        messages.clear()
    for number, both in enumerate(zip(*FRAMES.values(), strict=True), 1):
        for plate, frame in zip(FRAMES, both, strict=True):
            send(plate, "signals", frame)
        send("point", "signals", UNTOUCHED)
        await decoded(number)
    found = {plate: sent[plate].copy() for plate in FRAMES}
    running.cancel()
    await asyncio.wait([running])
    assert found == expected
    assert all([path for path, _ in found[plate]].count("contacts/event") for plate in FRAMES)
    assert [path for path, _ in sent["right"][len(found["right"]) :]][-2:] == ["contacts/event", "contacts"]  # released
    for plate, health in plates.health().items():
        assert (health.decoded, health.skipped) == ((0, 8) if plate == "point" else (8, 0))
