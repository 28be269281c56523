"""Frames of many skins in one decoder: each on its own, plates in turn, decoders shared and few."""

import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import numpy as np
import pytest
from decoder_bench import NOISE, NU, SITES_M, E, Floats, info, pressed, until
from observer import running_task

from resonator_daemon.base.reasons import Reason
from resonator_daemon.daemon.remote_decoding import shared_plates
from resonator_daemon.daemon.remote_decoding.plate import SkinPlate
from resonator_daemon.daemon.remote_decoding.shared_plates import DECODERS_MAX, SharedStage
from resonator_daemon.estimate.elastic import HalfSpace
from resonator_daemon.estimate.surface.decoded import Decoded
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_decoder import SurfaceReading

LINEAR = DecodingOptions(contact_physics=False, background=False)


def skin(depth_m: float = 1e-3, sites_m: Floats = SITES_M) -> SkinPlate:
    return SkinPlate(Skin(HalfSpace(E, NU), sites_m, depth_m), np.arange(len(sites_m)), info().grid)


class Stage:
    """A stage and what it has delivered."""

    def __init__(self, wanted: DecodingOptions = LINEAR) -> None:
        self.delivered: list[tuple[str, int, SurfaceReading]] = []
        self.refused: list[tuple[str, Reason]] = []
        self.notes: list[Reason | None] = []
        self.stage = SharedStage[int](
            wanted,
            lambda *result: self.delivered.append(result),
            self.notes.append,
            lambda *said: self.refused.append(said),
        )

    @asynccontextmanager
    async def running(self) -> AsyncIterator["Stage"]:
        async with running_task(self.stage.run()):
            yield self

    def offer(self, plate: str, number: int, values: Floats, noise_std: Floats = NOISE, of: SkinPlate | None = None):  # type: ignore[no-untyped-def]
        self.stage.offer(plate, number, of or skin(), values, noise_std)

    async def read(
        self, plate: str, values: Floats, noise_std: Floats = NOISE, of: SkinPlate | None = None
    ) -> SurfaceReading:
        count = len(self.delivered)
        self.offer(plate, count, values, noise_std, of)
        await until(lambda: len(self.delivered) > count)
        return self.delivered[-1][2]


class Substitute:
    """In the place of the real decoder: counts how often it is set up, and decodes when it may."""

    name, shape = "substitute", (144,)
    built: list[tuple[float, float]]
    together: list[list[float]]  # what was decoded at once
    released = threading.Semaphore()

    def __init__(self, of: Skin, noise_std: Floats) -> None:
        self.noise = noise_std[0, 0]
        self.built.append((of.depth_m, self.noise))

    def fits(self, noise_std: Floats) -> bool:
        return bool(noise_std[0, 0] == self.noise)

    def decode_alone(self, signals: Floats, _noise_std: Floats) -> SurfaceReading:
        assert self.released.acquire(timeout=20)
        if signals[0, 0] == 7.0:
            raise ZeroDivisionError("shared")
        return SurfaceReading(self.name, Decoded(signals, signals, None, False, 0.0, 1.0, "ok", ""))

    def decode_untouched(self, signals: Floats, noise_std: Floats) -> list[SurfaceReading | None]:
        """Frames of a value above 0 show a load."""
        self.together.append(signals[:, 0, 0].tolist())
        return [None if one[0, 0] > 0.0 else self.decode_alone(one, noise_std[0]) for one in signals]

    def reset(self, reason: str) -> tuple[()]:
        return ()


@pytest.fixture
def substitute(monkeypatch: pytest.MonkeyPatch) -> type[Substitute]:
    Substitute.built, Substitute.together = [], []
    Substitute.released = threading.Semaphore(0)

    def put(of: Skin, _wanted: DecodingOptions, noise_std: Floats, _progress: Callable[[str], None]) -> Substitute:
        return Substitute(of, noise_std)

    monkeypatch.setattr(shared_plates, "set_up", put)
    return Substitute


def marked(value: float) -> Floats:
    return np.full((3, 144), value)


async def test_plates_take_turns_and_of_each_the_newest_is_decoded(substitute: type[Substitute]) -> None:
    async with Stage().running() as stage:
        stage.offer("a", 0, marked(0.0))
        await until(lambda: stage.stage.waiting("a") == 1 and bool(substitute.built))
        for number in range(1, 5):
            for plate in ("a", "b", "c"):
                stage.offer(plate, number, marked(0.0))
        assert [stage.stage.waiting(plate) for plate in "abc"] == [2, 1, 1]
        assert dict(stage.stage.skipped) == {"a": 3, "b": 3, "c": 3}
        substitute.released.release(4)
        await until(lambda: len(stage.delivered) == 4)
    assert [(plate, number) for plate, number, _ in stage.delivered] == [("a", 0), ("a", 4), ("b", 4), ("c", 4)]


async def test_waiting_frames_of_equal_skins_are_decoded_together_but_for_those_that_show_a_load(
    substitute: type[Substitute],
) -> None:
    async with Stage().running() as stage:
        stage.offer("first", 0, marked(0.0))
        await until(lambda: stage.stage.waiting("first") == 1 and bool(substitute.built))
        stage.offer("deep", 1, marked(0.0), of=skin(2e-3))
        for number in range(20):
            stage.offer(f"plate {number}", number, marked(float(number == 3)))
        substitute.released.release(100)
        await until(lambda: len(stage.delivered) == 22)
    assert [len(values) for values in substitute.together] == [16, 4]
    assert [plate for plate, _, _ in stage.delivered].index("plate 3") == 21
    assert stage.stage.skipped.total() == stage.stage.unusable.total() == 0


async def test_equal_skins_share_a_decoder_and_others_do_not(substitute: type[Substitute]) -> None:
    substitute.released.release(100)
    async with Stage().running() as stage:
        for plate in range(20):
            await stage.read(f"plate {plate}", marked(0.0))
        assert substitute.built == [(1e-3, 2.0**-7)]
        await stage.read("noisy", marked(0.0), 2 * NOISE)
        await stage.read("deep", marked(0.0), of=skin(2e-3))
        await stage.read("as before", marked(0.0))
    assert substitute.built == [(1e-3, 2.0**-7), (1e-3, 2.0**-6), (2e-3, 2.0**-7)]


async def test_of_many_different_skins_the_decoders_used_last_are_kept(substitute: type[Substitute]) -> None:
    substitute.released.release(100)
    depths_m = [1e-3 * (1 + i) for i in range(DECODERS_MAX + 1)]
    async with Stage().running() as stage:
        for depth_m in depths_m[:-1]:
            await stage.read("plate", marked(0.0), of=skin(depth_m))
        await stage.read("plate", marked(0.0), of=skin(depths_m[0]))  # used again: the second is the oldest now
        await stage.read("plate", marked(0.0), of=skin(depths_m[-1]))
        assert len(substitute.built) == DECODERS_MAX + 1
        await stage.read("plate", marked(0.0), of=skin(depths_m[0]))
        assert len(substitute.built) == DECODERS_MAX + 1
        await stage.read("plate", marked(0.0), of=skin(depths_m[1]))
    assert len(substitute.built) == DECODERS_MAX + 2


async def test_a_frame_that_fails_is_flagged_and_the_next_one_is_decoded(substitute: type[Substitute]) -> None:
    substitute.released.release(100)
    async with Stage().running() as stage:
        failed = await stage.read("a", marked(7.0))
        after = await stage.read("a", marked(1.0))
    assert (failed.decoded.status, after.decoded.status) == ("rejected", "ok")
    assert "ZeroDivisionError('shared')" in failed.decoded.reason


async def test_a_skin_that_cannot_be_decoded_is_refused_and_the_others_go_on() -> None:
    on_a_line = np.column_stack([np.arange(144) * 1e-4, np.zeros(144)])
    async with Stage(DecodingOptions("fourier", background=False)).running() as stage:
        stage.offer("line", 0, marked(0.0), of=skin(sites_m=on_a_line))
        await stage.read("grid", pressed(0))
        assert stage.stage.unusable["line"] == 1
        assert stage.stage.waiting("line") == 0
    ((plate, why),) = stage.refused
    assert plate == "line"
    assert why.code == "undecodable"
    assert stage.notes[-1] is None
    assert [plate for plate, _, _ in stage.delivered] == ["grid"]


async def test_what_waits_when_it_ends_is_counted_as_skipped(substitute: type[Substitute]) -> None:
    stage = Stage()
    async with stage.running():
        stage.offer("a", 0, marked(0.0))
        await until(lambda: bool(substitute.built))
        stage.offer("b", 0, marked(0.0))
        substitute.released.release(100)
    counted = len(stage.delivered) + stage.stage.skipped.total()
    assert counted == 2
    assert stage.stage.waiting("a") == stage.stage.waiting("b") == 0
