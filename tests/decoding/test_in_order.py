"""Decoding of each frame in its turn: nothing is skipped, and the same signals give the same results."""

from collections.abc import Callable

import numpy as np
import pytest
from stage_bench import LINEAR, NAN, NOISE, NOTHING, SKIN, Stage, SubstituteDecoder, marked, pressed

from resonator_daemon.decoding import in_order, stage
from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.in_order import DecodingInOrder
from resonator_daemon.decoding.skin import Wanted
from resonator_daemon.decoding.skin_contacts import SkinEvent
from resonator_daemon.decoding.skin_decoder import SurfaceReading

FRAMES = [NOTHING, pressed(0), pressed(1), pressed(2), NOTHING, NOTHING]


class InOrder:
    """A stage, and what it has delivered."""

    def __init__(self, wanted: Wanted = LINEAR) -> None:
        self.maps: list[tuple[str, Decoded]] = []
        self.readings: list[tuple[str, SurfaceReading]] = []
        self.announced: list[str] = []
        self.stage = DecodingInOrder[str](SKIN, wanted, self._map, self._reading, self.announced.append)

    def _map(self, origin: str, decoded: Decoded) -> None:
        self.maps.append((origin, decoded))

    def _reading(self, origin: str, reading: SurfaceReading) -> None:
        self.readings.append((origin, reading))


async def test_results_are_those_of_the_stage_that_follows_the_present() -> None:
    live, again = Stage(), InOrder()
    async with live.running():
        for number, frame in enumerate(FRAMES):
            live.stage.offer(str(number), frame, NOISE)
            origin, expected = await live.next()
            again.stage.offer(origin, frame, NOISE)
            assert again.maps[-1][0] == again.readings[-1][0] == origin
            reading = again.readings[-1][1]
            # Single precision; arrays that lie in memory otherwise are rounded otherwise.
            np.testing.assert_allclose(reading.decoded.traction_pascal, expected.decoded.traction_pascal, atol=1.0)
            assert [event.event for event in reading.events] == [event.event for event in expected.events]
    assert len(again.readings) == len(FRAMES)
    assert again.announced == []


def test_two_runs_are_the_same_with_contact_physics_too() -> None:
    runs = [InOrder(Wanted()) for _ in range(2)]
    for run in runs:
        for frame in FRAMES:
            run.stage.offer("frame", frame, NOISE)
    one, other = ([reading.decoded for _, reading in run.readings] for run in runs)
    for frame, again in zip(one, other, strict=True):
        np.testing.assert_allclose(again.traction_pascal, frame.traction_pascal, atol=1.0)
    assert any("contact" in reading.decoder for _, reading in runs[0].readings)


def test_contacts_end_with_the_last_frame_when_frames_stop() -> None:
    run = InOrder()
    run.stage.interrupt("no frames")  # nothing was there
    for seed in range(3):
        run.stage.offer(f"frame {seed}", pressed(seed), NOISE)
    run.stage.interrupt("no frames")
    run.stage.interrupt("no frames")
    origin, last = run.readings[-1]
    assert (origin, len(run.readings)) == ("frame 2", 4)
    assert [(event.event, event.reason) for event in last.events] == [("release", "no frames")]
    assert np.isnan(last.decoded.traction_pascal).all()


def test_frames_before_the_noise_is_known_are_counted() -> None:
    run = InOrder()
    run.stage.offer("deaf", NOTHING, np.full_like(NOISE, NAN))
    assert (run.stage.frames_skipped, run.readings) == (1, [])


def test_sites_that_cannot_be_decoded_are_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise ValueError("too close")

    monkeypatch.setattr(in_order, "set_up", refuse)
    run = InOrder()
    for _ in range(3):
        run.stage.offer("frame", NOTHING, NOISE)
    assert (run.announced, run.stage.frames_skipped) == (["nothing is decoded: too close"], 3)


def test_other_noise_needs_another_decoder_which_ends_the_contacts_of_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Ending(SubstituteDecoder):
        def succeed(self, other: "Ending") -> tuple[SkinEvent, ...]:
            return ("ended",)  # type: ignore[return-value]

    monkeypatch.setattr(stage, "SkinDecoder", Ending)
    monkeypatch.setattr(stage, "cached", take_it)
    run = InOrder()
    for noise_std in (NOISE, NOISE, 4 * NOISE):
        run.stage.offer("frame", marked(1.0), noise_std)
    assert [reading.events for _, reading in run.readings] == [(), (), ("ended",)]


def take_it(_depends_on: object, build: Callable[[], SubstituteDecoder]) -> SubstituteDecoder:
    return build()
