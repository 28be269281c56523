"""The decoding stage: every result with its origin, the newest frame first, and no decoder without known noise."""

import asyncio
import queue
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from threadpoolctl import threadpool_info, threadpool_limits

from resonator_daemon.decoding import Decoded, FourierDecoder
from resonator_daemon.decoding import stage as stage_module
from resonator_daemon.decoding.stage import DecodingStage
from resonator_daemon.elastic import HalfSpace

Floats = NDArray[np.float64]

SHAPE = NY, NX = 6, 8
SITES = NY * NX
PITCH_M, DEPTH_M = 4e-4, 1e-3
HALF_SPACE = HalfSpace(2e5, 0.5)
NOISE = np.tile([[1e-3], [2e-3], [3e-3]], SITES)
NAN = np.nan
DEADLINE_S = 30.0  # far beyond what any of this takes: it ends a test that hangs


class Stage:
    """A stage and what it has delivered."""

    def __init__(self, shape: tuple[int, int] = SHAPE) -> None:
        self.delivered: asyncio.Queue[tuple[str, Decoded]] = asyncio.Queue()
        self.delivered_in: set[threading.Thread] = set()
        self.stage = DecodingStage[str](HALF_SPACE, shape, PITCH_M, DEPTH_M, self._deliver)

    def _deliver(self, origin: str, decoded: Decoded) -> None:
        self.delivered_in.add(threading.current_thread())
        self.delivered.put_nowait((origin, decoded))

    @asynccontextmanager
    async def running(self) -> AsyncIterator["asyncio.Task[None]"]:
        task = asyncio.create_task(self.stage.run())
        try:
            yield task
        finally:
            task.cancel()
            await asyncio.wait([task])

    async def next(self) -> tuple[str, Decoded]:
        return await asyncio.wait_for(self.delivered.get(), DEADLINE_S)


class SubstituteDecoder:
    """In the place of the real one: remembers what it was given and answers with its first signal."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def decode(self, signals: Floats, *, displacement: bool = False) -> Decoded:
        empty = np.zeros((3, *signals.shape[1:]))
        return Decoded(empty, empty, empty if displacement else None, False, 0.0, signals.flat[0], "ok", "")


class HeldDecoder(SubstituteDecoder):
    """Decodes when it is told to."""

    entered: "queue.Queue[float]"
    released: threading.Semaphore
    threads: set[threading.Thread]

    def decode(self, signals: Floats, *, displacement: bool = False) -> Decoded:
        self.threads.add(threading.current_thread())
        self.entered.put(float(signals.flat[0]))
        assert self.released.acquire(timeout=DEADLINE_S)
        return super().decode(signals, displacement=displacement)

    @classmethod
    async def wait_until_entered(cls) -> float:
        return await asyncio.to_thread(cls.entered.get, timeout=DEADLINE_S)


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> type[HeldDecoder]:
    """Substitute a decoder that waits."""
    HeldDecoder.entered, HeldDecoder.released, HeldDecoder.threads = queue.Queue(), threading.Semaphore(0), set()
    monkeypatch.setattr(stage_module, "FourierDecoder", HeldDecoder)
    return HeldDecoder


def some_signals(seed: int) -> Floats:
    """Signals (3, sites) of a point load of 50 mN somewhere, with noise: Boussinesq's solution for nu = 1/2."""
    random = np.random.default_rng(seed)
    x0, y0 = random.uniform(-1.0, 1.0, 2) * PITCH_M
    iy, ix = np.divmod(np.arange(SITES), NX)
    dx, dy = (ix - 3.5) * PITCH_M - x0, (iy - 2.5) * PITCH_M - y0
    r = np.sqrt(dx**2 + dy**2 + DEPTH_M**2)
    scale = 0.05 * DEPTH_M / (np.pi * 2e5)
    pressure, shear = -0.75 * scale / r**3, -2.25 * scale * DEPTH_M / r**5
    return np.array([pressure, shear * dx, shear * dy]) + random.normal(0.0, NOISE)


def marked(value: float) -> Floats:
    return np.full((3, SITES), value)


def by_rows(signals: Floats) -> Floats:
    """Sites in their order, iy nx + ix, on the grid [iy, ix]."""
    grid = np.empty((3, NY, NX))
    for iy in range(NY):
        for ix in range(NX):
            grid[:, iy, ix] = signals[:, iy * NX + ix]
    return grid


async def test_results_are_those_of_the_decoder_and_come_with_their_origin() -> None:
    direct = FourierDecoder(HALF_SPACE, SHAPE, PITCH_M, DEPTH_M, NOISE[:, 0])
    stage = Stage()
    async with stage.running():
        for seed in range(4):
            stage.stage.offer(f"frame {seed}", some_signals(seed), NOISE)
            origin, decoded = await stage.next()
            expected = direct.decode(by_rows(some_signals(seed)), displacement=True)
            assert origin == f"frame {seed}"
            assert decoded.status == expected.status == "ok"
            assert decoded.displacement_m is not None
            assert expected.displacement_m is not None
            np.testing.assert_allclose(decoded.traction_pascal, expected.traction_pascal, rtol=1e-9, atol=1e-6)
            np.testing.assert_allclose(decoded.traction_std_pascal, expected.traction_std_pascal, rtol=1e-9)
            np.testing.assert_allclose(decoded.displacement_m, expected.displacement_m, rtol=1e-9, atol=1e-16)
            assert decoded.chi2 == pytest.approx(expected.chi2)
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
        assert [(origin, decoded.chi2) for origin, decoded in results] == [("first", 1.0), ("number 4", 4.0)]
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
        origin, decoded = await stage.next()
    assert (origin, decoded.chi2) == ("new", 2.0)
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
    assert stage.delivered_in == {threading.main_thread()}
    assert held.threads.isdisjoint(stage.delivered_in)


async def test_a_frame_of_nan_gives_nan_with_its_reason_and_spoils_no_other() -> None:
    stage = Stage()
    async with stage.running():
        results = []
        for signals in (some_signals(1), np.full((3, SITES), NAN), some_signals(1)):
            stage.stage.offer("frame", signals, NOISE)
            results.append((await stage.next())[1])
    before, unknown, after = results
    assert unknown.status == "no_signal"
    assert unknown.reason
    assert unknown.displacement_m is not None
    for array in (unknown.traction_pascal, unknown.traction_std_pascal, unknown.displacement_m):
        assert array.shape == (3, NY, NX)
        assert np.isnan(array).all()
    np.testing.assert_array_equal(after.traction_pascal, before.traction_pascal)


@pytest.mark.parametrize("unknown", [NAN, np.inf])
async def test_without_noise_of_every_channel_there_is_no_decoder_yet(
    unknown: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged: queue.Queue[None] = queue.Queue()
    judge = stage_module._median_by_channel

    def remembered(noise_std: Floats) -> Floats | None:
        judged.put(None)
        return judge(noise_std)

    monkeypatch.setattr(stage_module, "_median_by_channel", remembered)
    deaf = NOISE.copy()
    deaf[1] = unknown
    stage = Stage()
    async with stage.running():
        stage.stage.offer("deaf", some_signals(1), deaf)
        await asyncio.to_thread(judged.get, timeout=DEADLINE_S)
        stage.stage.offer("heard", some_signals(2), NOISE)
        origin, decoded = await stage.next()
    assert (origin, decoded.status) == ("heard", "ok")
    assert stage.stage.frames_skipped == 0
    assert stage.delivered.empty()


async def test_the_first_frame_that_is_heard_makes_the_decoder_and_another_noise_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[SubstituteDecoder] = []

    class Remembered(SubstituteDecoder):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr(stage_module, "FourierDecoder", Remembered)
    stage = Stage((2, 2))
    # Medians of what is known in each channel, by hand: 2 of 1 2 5, 4 of 4 4 8, 5 between 3 and 7.
    noise = np.array([[1.0, 5.0, 2.0, NAN], [4.0, 4.0, np.inf, 8.0], [9.0, 1.0, 3.0, 7.0]])
    async with stage.running():
        for noise_std in (noise, 1.4 * noise, np.full((3, 4), NAN), 10 * noise):
            stage.stage.offer("frame", np.zeros((3, 4)), noise_std)
            await stage.next()
    for decoder, factor in zip(made, (1.0, 10.0), strict=True):
        *place, channel_std = decoder.arguments
        assert place == [HALF_SPACE, (2, 2), PITCH_M, DEPTH_M]
        np.testing.assert_array_equal(channel_std, [2.0 * factor, 4.0 * factor, 5.0 * factor])


async def test_the_linear_algebra_keeps_to_one_thread_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    def blas_threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    seen: list[set[int]] = []

    class Counting(SubstituteDecoder):
        def decode(self, signals: Floats, *, displacement: bool = False) -> Decoded:
            seen.append(blas_threads())
            return super().decode(signals, displacement=displacement)

    monkeypatch.setattr(stage_module, "FourierDecoder", Counting)
    stage = Stage()
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        async with stage.running():
            stage.stage.offer("frame", marked(1.0), NOISE)
            await stage.next()
        assert blas_threads() == before
    assert seen == [{1}]


async def test_a_mistake_in_the_decoder_ends_the_stage_and_is_not_hidden() -> None:
    stage = Stage()
    async with stage.running() as task:
        stage.stage.offer("frame", np.zeros((3, SITES + 1)), np.ones((3, SITES + 1)))
        with pytest.raises(ValueError, match="reshape"):
            await asyncio.wait_for(task, DEADLINE_S)


async def test_it_ends_when_cancelled_while_it_waits() -> None:
    stage = Stage()
    async with stage.running() as task:
        await asyncio.sleep(0)
    assert task.cancelled()
