"""The decoding stage: every result with its origin, the newest frame first, and nothing in a frame that stops it."""

import asyncio
import logging
import queue
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skin_scenes import DEPTH_M, FRICTION, PITCH_M, RADIUS_M
from stage_bench import (
    DEADLINE_S,
    LINEAR,
    NAN,
    NOISE,
    NOTHING,
    SHAPE,
    SITES,
    SKIN,
    Floats,
    HeldDecoder,
    Stage,
    SubstituteDecoder,
    marked,
    pressed,
)
from threadpoolctl import threadpool_info, threadpool_limits

from resonator_daemon.decoding import Decoded
from resonator_daemon.decoding import stage as stage_module
from resonator_daemon.decoding.skin import Skin, Wanted
from resonator_daemon.decoding.skin_decoder import SkinDecoder, SurfaceReading
from simulators.contact import pixel_tractions


async def test_results_are_those_of_the_decoder_and_come_with_their_origin() -> None:
    direct, stage = SkinDecoder(SKIN, LINEAR, NOISE, [].append), Stage()
    async with stage.running():
        for seed in range(4):
            stage.stage.offer(f"frame {seed}", pressed(seed), NOISE)
            origin, reading = await stage.next()
            expected = direct.decode(pressed(seed), NOISE)
            assert origin == f"frame {seed}"
            assert reading.decoder == "open-plane"
            # Single precision; matrices that come from the cache may lie in memory otherwise.
            np.testing.assert_allclose(reading.decoded.traction_pascal, expected.decoded.traction_pascal, atol=1.0)
            np.testing.assert_allclose(reading.decoded.displacement_m, expected.decoded.displacement_m, atol=1e-9)
            assert [contact.id for contact in reading.contacts] == [contact.id for contact in expected.contacts]
            assert [event.event for event in reading.events] == (["onset"] if seed == 1 else [])
    assert stage.stage.frames_skipped == 0


async def test_while_busy_the_newest_replaces_those_that_wait(held: type[HeldDecoder]) -> None:
    stage = Stage()
    async with stage.running():
        stage.stage.offer("first", marked(1.0), NOISE)
        assert await held.wait_until_entered() == 1.0
        for number in (2, 3, 4):
            stage.stage.offer(f"number {number}", marked(float(number)), NOISE)
        assert stage.stage.frames_skipped == 2
        held.released.release()
        assert await held.wait_until_entered() == 4.0
        held.released.release()
        results = [await stage.next() for _ in range(2)]
        assert [(origin, reading.decoded.chi2) for origin, reading in results] == [("first", 1.0), ("number 4", 4.0)]
        stage.stage.offer("fifth", marked(5.0), NOISE)
        assert await held.wait_until_entered() == 5.0
        held.released.release()
        assert (await stage.next())[0] == "fifth"
    assert stage.stage.frames_skipped == 2
    assert stage.delivered.empty()


async def test_of_the_frames_before_the_start_the_newest_is_decoded(held: type[HeldDecoder]) -> None:
    stage = Stage()
    stage.stage.offer("old", marked(1.0), NOISE)
    stage.stage.offer("new", marked(2.0), NOISE)
    held.released.release()
    async with stage.running():
        origin, reading = await stage.next()
    assert (origin, reading.decoded.chi2) == ("new", 2.0)
    assert stage.stage.frames_skipped == 1


async def test_decoding_leaves_the_event_loop_free_and_delivers_on_it(held: type[HeldDecoder]) -> None:
    stage = Stage()
    async with stage.running():
        for _ in range(2):
            stage.stage.offer("frame", marked(1.0), NOISE)
            await held.wait_until_entered()  # this runs while the decoder waits
            held.released.release()
            await stage.next()
    assert len(held.threads) == 1
    assert stage.called_in == {threading.main_thread()}
    assert held.threads.isdisjoint(stage.called_in)


async def test_a_frame_of_nan_gives_nan_with_its_reason_and_spoils_no_other() -> None:
    stage = Stage()
    async with stage.running():
        before, unknown, deaf, after = [
            (await stage.read(signals, noise_std)).decoded
            for signals, noise_std in (
                (pressed(), NOISE),
                (np.full((3, SITES), NAN), NOISE),
                (pressed(), np.full((3, SITES), NAN)),
                (pressed(), NOISE),
            )
        ]
    for decoded in (unknown, deaf):
        assert decoded.status == "no_signal"
        assert decoded.reason
        assert decoded.displacement_m is not None
        for array in (decoded.traction_pascal, decoded.traction_std_pascal, decoded.displacement_m):
            assert array.shape == (3, *SHAPE)
            assert np.isnan(array).all()
    np.testing.assert_array_equal(after.traction_pascal, before.traction_pascal)


@pytest.mark.parametrize("unknown", [NAN, np.inf])
async def test_without_noise_of_every_channel_there_is_no_decoder_yet(
    unknown: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged: queue.Queue[None] = queue.Queue()
    judge = stage_module.rounded_noise

    def remembered(skin: Skin, noise_std: Floats) -> Floats | None:
        judged.put(None)
        return judge(skin, noise_std)

    monkeypatch.setattr(stage_module, "rounded_noise", remembered)
    deaf = NOISE.copy()
    deaf[1] = unknown
    stage = Stage()
    async with stage.running():
        stage.stage.offer("deaf", pressed(1), deaf)
        await asyncio.to_thread(judged.get, timeout=DEADLINE_S)
        stage.stage.offer("heard", pressed(2), NOISE)
        origin, reading = await stage.next()
    assert (origin, reading.decoded.status) == ("heard", "ok")
    assert stage.stage.frames_skipped == 1
    assert stage.delivered.empty()


async def test_another_noise_builds_another_decoder_and_ends_the_contacts_of_the_one_before() -> None:
    stage = Stage()
    async with stage.running():
        onset = [await stage.read(pressed(seed)) for seed in range(2)][1]
        still = await stage.read(pressed(2), 1.45 * NOISE)
        assert stage.announced.count("") == 1
        ended = await stage.read(pressed(3), 1.6 * NOISE)
        assert stage.announced.count("") == 2
        again = await stage.read(pressed(4), 1.6 * NOISE)
    assert [event.event for event in onset.events] == ["onset"]
    assert [contact.id for contact in still.contacts] == [1]
    assert [(event.event, event.contact.id) for event in ended.events] == [("release", 1)]
    assert ended.contacts == ()
    assert [(event.event, event.contact.id) for event in again.events] == [("onset", 2)]


async def test_setting_up_is_announced_until_it_is_done_and_done_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    readings = []
    for expected in (["open-plane decoder of 144 sites", "contact shapes"], []):
        stage = Stage()
        async with stage.running():
            readings.append(await stage.read(pressed()))
            readings.append(await stage.read(pressed()))
        assert stage.announced == [*(f"decoder is being set up: {step}" for step in expected), ""]
        assert stage.called_in == {threading.main_thread()}
    assert len(list(tmp_path.iterdir())) == 1
    first, kept = readings[1], readings[3]
    np.testing.assert_array_equal(kept.decoded.traction_pascal, first.decoded.traction_pascal)
    assert [contact.id for contact in kept.contacts] == [contact.id for contact in first.contacts] == [1]


class SometimesFailing(SkinDecoder):
    """Fails on frames whose first signal is 7, and on the contacts of those where it is 8."""

    def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
        if signals[0, 0] == 7.0:
            raise ZeroDivisionError("seven")
        self.fails_later = signals[0, 0] == 8.0
        return super().decode_map(signals, noise_std)

    def read_contacts(self, decoded: Decoded) -> SurfaceReading:
        if self.fails_later:
            raise ZeroDivisionError("eight")
        return super().read_contacts(decoded)


async def test_a_decoder_that_fails_on_a_frame_flags_it_ends_the_contacts_and_goes_on(
    substitute: Callable[[Any], None], caplog: pytest.LogCaptureFixture
) -> None:
    substitute(SometimesFailing)
    stage = Stage()
    async with stage.running():
        for seed in range(2):
            (*_, onset) = (await stage.read(pressed(seed))).events or [None]
        failed = await stage.read(marked(7.0))
        after = [await stage.read(pressed(seed)) for seed in range(2)]
    assert onset is not None
    assert (onset.event, onset.contact.id) == ("onset", 1)
    assert failed.decoded.status == "rejected"
    assert "ZeroDivisionError('seven')" in failed.decoded.reason
    assert failed.decoder == "open-plane"
    assert failed.decoded.traction_pascal.shape == (3, *SHAPE)
    assert np.isnan(failed.decoded.traction_pascal).all()
    assert failed.contacts == ()
    assert [(event.event, event.contact.id) for event in failed.events] == [("release", 1)]
    assert after[0].decoded.status == "ok"
    assert [(event.event, event.contact.id) for event in after[1].events] == [("onset", 2)]
    assert "Traceback" in caplog.text


async def test_contacts_that_cannot_be_read_end_and_their_map_was_told_before(
    substitute: Callable[[Any], None], caplog: pytest.LogCaptureFixture
) -> None:
    substitute(SometimesFailing)
    stage = Stage()
    async with stage.running():
        for seed in range(2):
            await stage.read(pressed(seed))
        failed = await stage.read(marked(8.0))
        after = [await stage.read(pressed(seed)) for seed in range(2)]
    assert [decoded.status for _, decoded in stage.maps] == ["ok"] * 5
    assert (failed.decoded.status, failed.contacts) == ("rejected", ())
    assert "ZeroDivisionError('eight')" in failed.decoded.reason
    assert [(event.event, event.contact.id) for event in failed.events] == [("release", 1)]
    assert [(event.event, event.contact.id) for event in after[1].events] == [("onset", 2)]
    assert "Traceback" in caplog.text


async def test_the_map_is_told_before_the_contacts_are_read(substitute: Callable[[Any], None]) -> None:
    asked, released = threading.Event(), threading.Event()

    class Slow(SubstituteDecoder):
        def read_contacts(self, decoded: Decoded) -> SurfaceReading:
            asked.set()
            assert released.wait(DEADLINE_S)
            return super().read_contacts(decoded)

    substitute(Slow)
    stage = Stage()
    async with stage.running():
        stage.stage.offer("frame", marked(5.0), NOISE)
        assert await asyncio.to_thread(asked.wait, DEADLINE_S)
        ((origin, decoded),) = stage.maps
        assert (origin, decoded.chi2) == ("frame", 5.0)
        assert stage.delivered.empty()
        released.set()
        assert (await stage.next())[1].decoded is decoded


class Watched(SkinDecoder):
    """Notes in which threads it works."""

    decoding: set[str]
    rebuilding: "queue.Queue[str]"

    def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
        self.decoding.add(threading.current_thread().name)
        return super().decode_map(signals, noise_std)

    def read_contacts(self, decoded: Decoded) -> SurfaceReading:
        self.decoding.add(threading.current_thread().name)
        return super().read_contacts(decoded)

    def rebuild(self) -> None:
        super().rebuild()
        self.rebuilding.put(threading.current_thread().name)


async def test_contact_physics_follows_in_a_second_thread(substitute: Callable[[Any], None]) -> None:
    """The surface is then nearer to that of the closed forms than the map cut to the contact, and than the map."""
    Watched.decoding, Watched.rebuilding = set(), queue.Queue()
    substitute(Watched)
    truth = pixel_tractions((0.3, 0.0, 1.0), (0.0, 0.0), RADIUS_M, FRICTION, SHAPE, PITCH_M)

    def error(reading: SurfaceReading) -> float:
        return float(np.linalg.norm(reading.decoded.traction_pascal - truth) / np.linalg.norm(truth))

    stage = Stage(Wanted(friction_coefficient=FRICTION))
    async with stage.running():
        first = await stage.read(pressed())
        rebuilt_in = await asyncio.to_thread(Watched.rebuilding.get, timeout=DEADLINE_S)
        solved = await stage.read(pressed())
        linear = SkinDecoder(SKIN, LINEAR, NOISE, [].append).decode(pressed(), NOISE)
    assert first.decoder == solved.decoder == "open-plane+contact"
    assert solved.decoded.status == "ok"
    assert first.decoded.chi2 == pytest.approx(float(linear.decoded.chi2), rel=1e-3)
    assert solved.decoded.chi2 != pytest.approx(float(linear.decoded.chi2), rel=1e-3)
    assert error(solved) < error(first) < error(linear)
    assert error(solved) < 0.7 * error(linear)
    (decoded_in,) = Watched.decoding
    assert decoded_in.startswith("decoding")
    assert rebuilt_in.startswith("rebuilding")


class Rebuilding(SubstituteDecoder):
    """Wants to be rebuilt after every frame; fails at it for the first time, and takes a while."""

    rebuild_wanted = True
    spans_s: "queue.Queue[tuple[float, float]]"

    def rebuild(self) -> None:
        begun_s = time.monotonic()
        threading.Event().wait(0.03)
        self.spans_s.put((begun_s, time.monotonic()))
        if self.spans_s.qsize() == 1:
            raise ZeroDivisionError("rebuild")


async def test_rebuilding_goes_on_after_a_failure_and_takes_no_more_than_a_third_of_a_processor(
    substitute: Callable[[Any], None], caplog: pytest.LogCaptureFixture
) -> None:
    Rebuilding.spans_s = queue.Queue()
    substitute(Rebuilding)
    stage = Stage()
    async with stage.running(), asyncio.timeout(DEADLINE_S):
        while Rebuilding.spans_s.qsize() < 4:
            await stage.read(NOTHING)
    spans_s = list(Rebuilding.spans_s.queue)
    for (begun_s, ended_s), (next_s, _) in pairwise(spans_s):
        assert next_s - begun_s >= 3.0 * (ended_s - begun_s)
    assert caplog.text.count("ZeroDivisionError: rebuild") == 1


async def test_the_linear_algebra_keeps_to_one_thread_meanwhile(substitute: Callable[[Any], None]) -> None:
    def blas_threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    seen: list[set[int]] = []

    class Counting(SubstituteDecoder):
        def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
            seen.append(blas_threads())
            return super().decode_map(signals, noise_std)

    substitute(Counting)
    stage = Stage()
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        async with stage.running():
            await stage.read(NOTHING)
        assert blas_threads() == before
    assert seen == [{1}]


async def test_sites_that_cannot_be_decoded_are_announced_and_end_it(caplog: pytest.LogCaptureFixture) -> None:
    twice = SKIN.site_positions_m.copy()
    twice[1] = twice[0]
    stage = Stage(skin=Skin(SKIN.half_space, twice, DEPTH_M))
    async with stage.running() as task:
        stage.stage.offer("frame", NOTHING, NOISE)
        await asyncio.wait_for(task, DEADLINE_S)
    assert stage.announced[-1].startswith("nothing is decoded: sites 0 and 1 are both at")
    assert [record.levelno for record in caplog.records] == [logging.ERROR]
    assert stage.delivered.empty()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError("no room"), "no room"),
        (OverflowError("too large"), "too large"),
        (ZeroDivisionError("by zero"), "by zero"),
        (IndexError("odd"), "decoder could not be set up: IndexError('odd')"),
    ],
)
async def test_a_set_up_that_fails_is_announced_and_ends_it(
    error: Exception, said: str, substitute: Callable[[Any], None], caplog: pytest.LogCaptureFixture
) -> None:
    class Failing(SubstituteDecoder):
        def __init__(self, *arguments: Any) -> None:
            raise error

    substitute(Failing)
    stage = Stage()
    async with stage.running() as task:
        stage.stage.offer("frame", NOTHING, NOISE)
        await asyncio.wait_for(task, DEADLINE_S)
    assert stage.announced[-1] == f"nothing is decoded: {said}"
    assert {record.levelno for record in caplog.records} == {logging.ERROR}


async def test_a_programmers_mistake_ends_the_stage_and_is_not_hidden() -> None:
    stage = Stage()
    async with stage.running() as task:
        await stage.read(NOTHING)
        stage.stage.offer("frame", np.zeros((3, SITES + 1)), np.ones((3, SITES + 1)))
        with pytest.raises(ValueError, match="shape"):
            await asyncio.wait_for(task, DEADLINE_S)


async def test_a_set_up_that_goes_on_does_not_stop_the_event_loop_when_cancelled(
    substitute: Callable[[Any], None],
) -> None:
    began, may_end = threading.Event(), threading.Event()

    class Slow(SubstituteDecoder):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            began.set()
            assert may_end.wait(DEADLINE_S)

    substitute(Slow)
    stage = Stage()
    task = asyncio.create_task(stage.stage.run())
    stage.stage.offer("frame", NOTHING, NOISE)
    assert await asyncio.to_thread(began.wait, DEADLINE_S)
    task.cancel()
    await asyncio.sleep(0.01)  # the event loop runs, or this never returns
    assert not task.done()
    may_end.set()
    await asyncio.wait([task], timeout=DEADLINE_S)
    assert task.cancelled()


def workers() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith(("decoding", "rebuilding"))]


@pytest.mark.parametrize("frames", [0, 1, 2])
async def test_it_ends_with_all_its_threads_when_cancelled(frames: int, substitute: Callable[[Any], None]) -> None:
    Rebuilding.spans_s = queue.Queue()
    substitute(Rebuilding)
    stage = Stage()
    async with stage.running() as task:
        await asyncio.sleep(0)
        for _ in range(frames):
            await stage.read(NOTHING)
        assert len(workers()) >= min(frames, 1)
    assert task.cancelled()
    assert workers() == []
