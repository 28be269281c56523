"""The streaming decoder: frames in the order of time, through changes of noise and failures of frames."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contact_scenes import DEPTH_M, NU, E, grid_positions
from skin_scenes import noisy, press

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface import decoder_setup
from resonator_daemon.estimate.surface.decoded import Decoded
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_contacts import SkinEvent
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder, SurfaceReading
from resonator_daemon.estimate.surface.streaming import StreamingDecoder, UndecodableError

SHAPE, SITES = (12, 12), 144
SKIN = Skin(HalfSpace(E, NU), grid_positions(SHAPE), DEPTH_M)
NOISE = np.tile([[2.0**-7], [2.0**-8], [2.0**-8]], SITES)  # powers of two, which rounding keeps
LINEAR = DecodingOptions(contact_physics=False)


class SubstituteDecoder:
    """In the place of the real one: knows its noise, and answers with the first signal as chi2."""

    name, shape = "substitute", (SITES,)

    def __init__(self, skin: Skin, wanted: DecodingOptions, noise_std: Floats, progress: Callable[[str], None]) -> None:
        self.built_for = noise_std

    def fits(self, noise_std: Floats) -> bool:
        return bool(noise_std[0, 0] == self.built_for[0, 0])

    def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
        return Decoded(signals, signals, None, False, 0.0, float(signals[0, 0]), "ok", "")

    def read_contacts(self, decoded: Decoded) -> SurfaceReading:
        return SurfaceReading(self.name, decoded)

    def succeed(self, other: "SubstituteDecoder") -> tuple[SkinEvent, ...]:
        return ()

    def rebuild(self, pause: Callable[[], None]) -> bool:
        return False


def pressed(seed: int = 0) -> Floats:
    """A frame of 1 N with some shear in the middle."""
    signals = press(shear_newton=(0.3, 0.0), sites_m=SKIN.site_positions_m)
    return noisy(signals, np.random.default_rng(seed), NOISE)


def marked(value: float) -> Floats:
    return np.full((3, SITES), value)


@pytest.fixture
def substitute(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[SubstituteDecoder]], None]:
    """Put another decoder in the place of the real one, and keep none in files."""

    def put(decoder: type[SubstituteDecoder]) -> None:
        monkeypatch.setattr(decoder_setup, "SkinDecoder", decoder)
        monkeypatch.setattr(decoder_setup, "cached", lambda _, build: build())

    return put


def streaming(wanted: DecodingOptions = LINEAR, skin: Skin = SKIN, **options: Any) -> StreamingDecoder:
    return StreamingDecoder(skin, wanted, lambda _: None, **options)


def read(decoder: StreamingDecoder, signals: Floats, noise_std: Floats = NOISE) -> SurfaceReading:
    assert decoder.prepare(noise_std)
    decoder.decode_map(signals, noise_std)
    return decoder.read_contacts()


def events_of(reading: SurfaceReading) -> list[tuple[str, int]]:
    return [(event.event, event.contact.id) for event in reading.events]


@pytest.mark.parametrize("unknown", [np.nan, np.inf])
def test_without_noise_of_every_channel_there_is_no_decoder_yet(unknown: float) -> None:
    deaf = NOISE.copy()
    deaf[1] = unknown
    decoder = streaming()
    assert not decoder.prepare(deaf)
    assert decoder.end_contacts("nothing was there") is None
    assert read(decoder, pressed()).decoded.status == "ok"


def test_another_noise_builds_another_decoder_and_ends_the_contacts_of_the_one_before() -> None:
    decoder = streaming()
    onset = [read(decoder, pressed(seed)) for seed in range(2)][1]
    still = read(decoder, pressed(2), 1.45 * NOISE)
    ended = read(decoder, pressed(3), 1.6 * NOISE)
    again = read(decoder, pressed(4), 1.6 * NOISE)
    assert events_of(onset) == [("onset", 1)]
    assert [contact.id for contact in still.contacts] == [1]
    assert events_of(ended) == [("release", 1)]
    assert ended.contacts == ()
    assert events_of(again) == [("onset", 2)]


def test_an_interruption_ends_contacts_for_its_reason_and_only_once() -> None:
    unplugged = Reason(ReasonCode.NO_FRAMES, "unplugged")
    decoder = streaming()
    for seed in range(3):
        read(decoder, pressed(seed))
    ended = decoder.end_contacts(unplugged)
    assert ended is not None
    assert [(event.event, event.contact.id, event.reason) for event in ended.events] == [("release", 1, unplugged)]
    assert (ended.decoded.status, ended.decoded.reason, ended.contacts) == ("no_signal", "unplugged", ())
    assert np.isnan(ended.decoded.traction_pascal).all()
    assert decoder.end_contacts("unplugged again") is None
    assert [events_of(read(decoder, pressed(seed))) for seed in range(2)] == [[], [("onset", 2)]]


def test_numbers_of_contacts_go_on_from_those_of_an_earlier_decoder() -> None:
    decoder = streaming(last_contact_id=41)
    assert [events_of(read(decoder, pressed(seed))) for seed in range(2)] == [[], [("onset", 42)]]


def test_steps_of_a_set_up_are_reported_until_it_is_done_and_done_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    readings = []
    for expected in (["open-plane decoder of 144 sites", "contact shapes"], []):
        steps: list[str] = []
        decoder = StreamingDecoder(SKIN, LINEAR, steps.append)
        readings += [read(decoder, pressed()), read(decoder, pressed())]
        assert steps == ["looking in the cache", *expected, ""]
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


@pytest.mark.parametrize(("value", "what"), [(7.0, "seven"), (8.0, "eight")])
def test_a_frame_that_fails_is_flagged_ends_the_contacts_and_the_next_one_is_decoded(
    value: float, what: str, substitute: Callable[[Any], None], caplog: pytest.LogCaptureFixture
) -> None:
    substitute(SometimesFailing)
    decoder = streaming()
    onset = [read(decoder, pressed(seed)) for seed in range(2)][1]
    failed = read(decoder, marked(value))
    after = [read(decoder, pressed(seed)) for seed in range(2)]
    assert events_of(onset) == [("onset", 1)]
    assert failed.decoded.status == "rejected"
    assert f"ZeroDivisionError('{what}')" in failed.decoded.reason
    assert (failed.decoder, failed.contacts) == ("open-plane", ())
    assert failed.decoded.traction_pascal.shape == (3, *SHAPE)
    assert np.isnan(failed.decoded.traction_pascal).all()
    assert events_of(failed) == [("release", 1)]
    assert after[0].decoded.status == "ok"
    assert events_of(after[1]) == [("onset", 2)]
    assert "Traceback" in caplog.text


def test_a_rebuild_that_fails_is_logged_and_costs_nothing_else(
    substitute: Callable[[Any], None], caplog: pytest.LogCaptureFixture
) -> None:
    class Failing(SubstituteDecoder):
        def rebuild(self, pause: Callable[[], None]) -> None:
            raise ZeroDivisionError("rebuild")

    substitute(Failing)
    decoder = streaming()
    read(decoder, marked(1.0))
    decoder.rebuild(lambda: None)
    assert caplog.text.count("ZeroDivisionError: rebuild") == 1
    assert read(decoder, marked(2.0)).decoded.chi2 == 2.0


def test_sites_that_cannot_be_decoded_are_refused_with_the_reason() -> None:
    twice = SKIN.site_positions_m.copy()
    twice[1] = twice[0]
    with pytest.raises(UndecodableError, match="sites 0 and 1 are 0 m apart"):
        streaming(skin=Skin(SKIN.half_space, twice, DEPTH_M)).prepare(NOISE)


@pytest.mark.parametrize("error", [MemoryError("no room"), OverflowError("large"), IndexError("odd")])
def test_a_set_up_that_fails_makes_the_skin_undecodable(
    error: Exception, substitute: Callable[[Any], None], caplog: pytest.LogCaptureFixture
) -> None:
    class Failing(SubstituteDecoder):
        def __init__(self, *arguments: Any) -> None:
            raise error

    substitute(Failing)
    with pytest.raises(UndecodableError, match=str(error)):
        streaming().prepare(NOISE)
    assert {record.levelno for record in caplog.records} <= {logging.ERROR}
