"""The decoding stage: where frames are counted, and how contacts end that no frame ends."""

import asyncio

import numpy as np
import pytest
from stage_bench import LINEAR, NAN, NOBODY, NOISE, SITES, SKIN, HeldDecoder, Stage, marked, pressed

from resonator_daemon.decoding.skin_contacts import SkinEvent


async def test_an_interruption_ends_contacts_under_the_last_frame_and_only_then() -> None:
    stage = Stage()
    async with stage.running():
        stage.stage.interrupt("unplugged")  # nothing to end yet
        for seed in range(3):
            await stage.read(pressed(seed))
        stage.stage.offer("last", pressed(3), NOISE)
        await stage.next()
        stage.stage.interrupt("unplugged")
        origin, ended = await stage.next()
        stage.stage.interrupt("unplugged again")
        await asyncio.sleep(0.05)
        assert stage.delivered.empty()  # there was nothing to end
        again = [await stage.read(pressed(seed)) for seed in range(2)]
    assert origin == "last"
    assert [(event.event, event.contact.id, event.reason) for event in ended.events] == [("release", 1, "unplugged")]
    assert (ended.decoded.status, ended.decoded.reason, ended.contacts) == ("no_signal", "unplugged", ())
    assert np.isnan(ended.decoded.traction_pascal).all()
    assert [(event.event, event.contact.id) for event in again[1].events] == [("onset", 2)]
    assert again[0].events == ()
    assert stage.delivered.empty()


async def test_releases_go_with_a_frame_that_came_before_they_could_be_told(
    held: type[HeldDecoder], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No reading without a surface comes between."""
    monkeypatch.setattr(held, "reset", lambda _: (SkinEvent("release", NOBODY),), raising=False)
    stage = Stage()
    async with stage.running():
        held.released.release()
        await stage.read(marked(1.0))
        await held.wait_until_entered()
        stage.stage.offer("busy", marked(2.0), NOISE)
        await held.wait_until_entered()
        stage.stage.interrupt("unplugged")
        stage.stage.offer("back", marked(3.0), NOISE)
        held.released.release(2)
        first, second = [await stage.next() for _ in range(2)]
    assert (first[0], first[1].events) == ("busy", ())
    assert second[0] == "back"
    assert [(event.event, event.reason) for event in second[1].events] == [("release", "unplugged")]
    assert stage.delivered.empty()


async def test_releases_survive_a_change_of_decoders_before_they_could_be_told(
    held: type[HeldDecoder], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of an interruption and those of the decoder that is replaced go with one frame."""
    monkeypatch.setattr(held, "reset", lambda _: (SkinEvent("release", NOBODY),), raising=False)
    monkeypatch.setattr(held, "succeed", lambda *_: (SkinEvent("release", NOBODY, "replaced"),))
    stage = Stage()
    async with stage.running():
        held.released.release(3)
        await stage.read(marked(1.0))
        stage.stage.interrupt("unplugged")
        stage.stage.offer("back", marked(2.0), 2 * NOISE)
        origin, reading = await stage.next()
    assert origin == "back"
    assert [event.reason for event in reading.events] == ["unplugged", "replaced"]
    assert stage.delivered.empty()


async def test_each_frame_is_delivered_skipped_or_waits(held: type[HeldDecoder]) -> None:
    stage = Stage()
    stage.stage.offer("before", marked(0.0), NOISE)
    assert stage.stage.waiting == 1
    async with stage.running():
        await held.wait_until_entered()
        assert stage.stage.waiting == 1
        for number in range(3):
            stage.stage.offer(f"number {number}", marked(1.0), NOISE)
        assert (stage.stage.waiting, stage.stage.frames_skipped) == (2, 2)
        held.released.release(2)
        await stage.next()
        await stage.next()
        assert stage.stage.waiting == 0
        stage.stage.offer("cut off", marked(1.0), NOISE)
        for _ in range(2):
            await held.wait_until_entered()
        held.released.release()
    assert stage.stage.waiting == 0
    assert stage.delivered.qsize() + stage.stage.frames_skipped == 3


async def test_a_stage_that_takes_anothers_place_ends_its_contacts_and_counts_on() -> None:
    first = Stage()
    async with first.running():
        for seed in range(2):
            await first.read(pressed(seed))
    second = Stage()
    second.stage = second.make_stage(SKIN, LINEAR, first.stage.latest)
    assert second.stage.latest is first.stage.latest
    async with second.running():
        readings = [await second.read(pressed(seed)) for seed in range(2)]
    assert [[(event.event, event.contact.id) for event in reading.events] for reading in readings] == [
        [("release", 1)],
        [("onset", 2)],
    ]


async def test_frames_without_noise_are_counted_apart() -> None:
    stage = Stage()
    async with stage.running():
        stage.stage.offer("deaf", pressed(), np.full((3, SITES), NAN))
        await asyncio.sleep(0)
        await stage.read(pressed())
    assert stage.stage.frames_without_noise == stage.stage.frames_skipped == 1
    assert stage.stage.waiting == 0
