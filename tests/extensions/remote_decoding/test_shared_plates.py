"""Frames that decoders share: each on its own, plates in turn, decoders for equal skins, and how many plates."""

import logging
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from decoder_bench import DEPTH_M, NOISE, Floats, incoming, info, pressed, signals, until
from observer import running_task

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.board.config.tables import Decoding
from resonator_daemon.estimate.surface.decoded import Decoded
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_decoder import SurfaceReading
from resonator_daemon.extensions.remote_decoding import plate, shared_plates
from resonator_daemon.extensions.remote_decoding.shared_plates import DECODERS_MAX, SharedPlates
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import DecoderPlateHealth, GridInfo, Info, Message, Signals


class Shared:
    """Shared plates, and what they have published."""

    def __init__(self, **options: Any) -> None:
        self.published: list[tuple[str, str, Any]] = []
        decoding = Decoding(plates=("+",), group="touch", **({"contact_physics": False} | options))
        self.plates = SharedPlates(DecoderConfig(decoding=decoding), "host-1", self._publish)
        self._info, self._signals = self.plates.subscriptions

    def _publish(self, plate: str, topic: Any, message: Message) -> None:
        self.published.append((plate, topic.path, message))

    @property
    def decoded(self) -> list[tuple[str, int]]:
        return [(plate, message.seq) for plate, path, message in self.published if path == "decoded"]

    def account(self, plate: str) -> DecoderPlateHealth:
        return self.plates.health()[plate]

    def send_info(self, plate: str, message: Info) -> None:
        self._info.handle(incoming(f"resonator/{plate}/info", encode(message)))

    def withdraw(self, plate: str) -> None:
        self._info.handle(incoming(f"resonator/{plate}/info", b""))

    def send(self, plate: str, message: Signals) -> None:
        self._signals.handle(incoming(f"resonator/{plate}/signals", encode(message)))

    async def read(self, plate: str, message: Signals) -> tuple[Any, Any]:
        """Send a frame; return what was decoded, and the summary; the contacts come last."""
        count = len(self.published)
        self.send(plate, message)
        await until(lambda: len(self.published) == count + 3)
        return self.published[-3][2], self.published[-2][2]

    @asynccontextmanager
    async def running(self) -> AsyncIterator["Shared"]:
        async with running_task(self.plates.run()):
            yield self


class Substitute:
    """In the place of the real decoder: counts how often it is set up, and decodes when it may."""

    name, shape = "substitute", (144,)
    built: list[tuple[float, float]]
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

    def reset(self, reason: str) -> tuple[()]:
        return ()


@pytest.fixture
def substitute(monkeypatch: pytest.MonkeyPatch) -> type[Substitute]:
    Substitute.built = []
    Substitute.released = threading.Semaphore(0)

    def put(of: Skin, _wanted: DecodingOptions, noise_std: Floats, _progress: Callable[[str], None]) -> Substitute:
        return Substitute(of, noise_std)

    monkeypatch.setattr(shared_plates, "set_up", put)
    return Substitute


def marked(seq: int, value: float = 0.0, noise: float = 1.0) -> Signals:
    return signals(seq, np.full((3, 144), value), noise_std=(noise * NOISE).astype(np.float32))


def deep(depth_m: float) -> Info:
    skin = info().skin
    assert skin is not None
    return info(skin=skin.model_copy(update={"depth_m": depth_m}))


async def test_plates_take_turns_and_of_each_the_newest_is_decoded(substitute: type[Substitute]) -> None:
    async with Shared().running() as shared:
        for name in "abc":
            shared.send_info(name, info())
        shared.send("a", marked(0))
        await until(lambda: shared.account("a").waiting == 1 and bool(substitute.built))
        for seq in range(1, 5):
            for name in "abc":
                shared.send(name, marked(seq))
        assert [shared.account(name).waiting for name in "abc"] == [2, 1, 1]
        assert [shared.account(name).skipped for name in "abc"] == [3, 3, 3]
        substitute.released.release(4)
        await until(lambda: len(shared.decoded) == 4)
    assert shared.decoded == [("a", 0), ("a", 4), ("b", 4), ("c", 4)]


async def test_equal_skins_share_a_decoder_and_of_others_those_used_last_are_kept(substitute: type[Substitute]) -> None:
    substitute.released.release(100)
    built = [(DEPTH_M, 2.0**-7)]
    async with Shared().running() as shared:
        for number in range(20):
            shared.send_info(f"plate-{number}", info())
            await shared.read(f"plate-{number}", marked(0))
        assert substitute.built == built
        await shared.read("plate-0", marked(1, noise=2.0))
        built.append((DEPTH_M, 2.0**-6))
        for number in range(2, DECODERS_MAX):
            shared.send_info("other", deep(DEPTH_M * number))
            await shared.read("other", marked(number))
            built.append((DEPTH_M * number, 2.0**-7))
        assert substitute.built == built
        await shared.read("plate-0", marked(2))  # used again: the noisy one is the oldest now
        shared.send_info("other", deep(0.5 * DEPTH_M))
        await shared.read("other", marked(10))
        built.append((0.5 * DEPTH_M, 2.0**-7))
        await shared.read("plate-0", marked(3))
        assert substitute.built == built
        await shared.read("plate-0", marked(4, noise=2.0))
        assert substitute.built == [*built, (DEPTH_M, 2.0**-6)]


async def test_a_frame_that_fails_is_flagged_and_the_next_one_is_decoded(substitute: type[Substitute]) -> None:
    substitute.released.release(100)
    async with Shared().running() as shared:
        shared.send_info("a", info())
        _, failed = await shared.read("a", marked(0, 7.0))
        _, after = await shared.read("a", marked(1, 1.0))
    assert (failed.status, failed.reason_code) == ("rejected", "decoding_failed")
    assert after.status == "ok"


async def test_a_skin_that_cannot_be_decoded_is_refused_and_the_others_go_on() -> None:
    on_a_line = tuple(site.model_copy(update={"position_m": (1e-4 * i, 0.0)}) for i, site in enumerate(info().sites))
    async with Shared(method="fourier", contact_physics=True).running() as shared:
        shared.send_info("line", info(sites=on_a_line, grid=None))
        shared.send_info("grid", info())
        shared.send("line", signals(0))
        await shared.read("grid", signals(0, pressed(0)))
        assert (shared.account("line").unusable, shared.account("line").waiting) == (1, 0)
        assert shared.plates.plates["line"].condition()[1].code == "undecodable"
        assert shared.plates.condition()[0] == "online"
    assert shared.decoded == [("grid", 0)]


async def test_what_waits_when_it_ends_is_counted_as_skipped(substitute: type[Substitute]) -> None:
    shared = Shared()
    async with shared.running():
        for name in "ab":
            shared.send_info(name, info())
            shared.send(name, marked(0))
        await until(lambda: bool(substitute.built))
        substitute.released.release(100)
    healths = shared.plates.health().values()
    assert sum(health.decoded + health.skipped for health in healths) == 2
    assert [health.waiting for health in healths] == [0, 0]


NOTHING = ("waiting", Reason(ReasonCode.NO_SIGNALS, "no signals that could be decoded"))


async def test_another_info_takes_effect_with_the_next_frame() -> None:
    moved = GridInfo(origin_m=(0.5, 0.5), pitch_m=4e-4, shape=(12, 12))
    sites = tuple(
        site.model_copy(update={"position_m": (site.position_m[0] + 0.5, site.position_m[1] + 0.5)})
        for site in info().sites
    )
    async with Shared().running() as shared:
        for plate in ("left", "right"):
            shared.send_info(plate, info())
            decoded, summary = await shared.read(plate, signals(0))
            assert decoded.grid.origin_m == info().sites[0].position_m
            assert decoded.decoder_id == summary.decoder_id == "host-1"
        shared.send_info("left", info(sites=sites, grid=moved))
        decoded, _ = await shared.read("left", signals(1))
        assert decoded.grid.origin_m == sites[0].position_m
        decoded, _ = await shared.read("right", signals(1))
        assert decoded.grid.origin_m == info().sites[0].position_m


async def test_it_is_online_while_signals_come_and_waits_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plate, "WAITS_AFTER_S", 0.2)
    async with Shared().running() as shared:
        assert shared.plates.condition() == NOTHING
        shared.send_info("left", info())
        shared.send_info("right", info(skin=None))
        shared.send("left", signals(0))
        problem = "right: has no skin to decode; waits for another plate of this name"
        decoding = Reason(ReasonCode.DECODING, f"signals of left are decoded; {problem}")
        await until(lambda: shared.plates.condition() == ("online", decoding))
        silent = Reason(ReasonCode.NO_SIGNALS, f"{problem}; left: {NOTHING[1].text}")
        await until(lambda: shared.plates.condition() == ("waiting", silent))


async def test_a_plate_that_its_daemon_decodes_is_left_alone_until_it_does_not() -> None:
    rates_hz = {"signals": 100.0, "decoded": 100.0}
    async with Shared().running() as shared:
        shared.send_info("left", info(rates_hz=rates_hz))
        shared.send_info("right", info())
        shared.send("left", signals(0))
        await shared.read("right", signals(0))
        assert {plate for plate, _, _ in shared.published} == {"right"}
        problem = "left: the daemon decodes this plate itself; set external = true in [decoding] of its configuration"
        assert problem in shared.plates.condition()[1].text
        shared.send_info("left", info())
        await shared.read("left", signals(1))
        shared.send_info("left", info(rates_hz=rates_hz))
        shared.send("left", signals(2))
        await shared.read("right", signals(1))
        assert [name for name, _ in shared.decoded].count("left") == 1
        assert problem in shared.plates.condition()[1].text


@pytest.mark.parametrize("name", ["decoder", "", "..", ".", "a b", " ", "$left", "a\x00b", "x" * 101])
def test_what_no_plate_is_called_is_passed_over(name: str) -> None:
    shared = Shared()
    shared.send_info(name, info())
    shared.send_info(name, info(skin=None))
    shared.send(name, signals(0))
    assert shared.plates.health() == {}
    assert shared.plates.condition() == NOTHING


async def test_a_plate_is_there_from_its_first_skin_until_its_info_is_gone() -> None:
    async with Shared().running() as shared:
        longest = "x" * 100
        shared.send(longest, signals(0))
        shared.send_info(longest, info(skin=None))
        shared.send(longest, signals(0))
        assert shared.plates.health() == {}
        shared.send_info(longest, info())
        await shared.read(longest, signals(0))
        assert shared.plates.health()[longest].received == 1
        shared.withdraw(longest)
        assert shared.plates.health() == {}
        assert shared.plates.condition() == NOTHING
        shared.send(longest, signals(1))
        shared.send_info(longest, info())
        await shared.read(longest, signals(2))
        account = shared.plates.health()[longest]
        assert (account.received, account.decoded, account.missed) == (1, 1, 0)
        shared.send_info("bad", info(skin=None))
        assert "bad" in shared.plates.condition()[1].text
        shared.withdraw("bad")
        assert "bad" not in shared.plates.condition()[1].text


async def test_a_plate_forgotten_while_its_frame_is_decoded_begins_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    began, may_end = threading.Event(), threading.Event()
    real = shared_plates.set_up

    def slow(*arguments: Any) -> Any:
        began.set()
        assert may_end.wait(20)
        return real(*arguments)

    monkeypatch.setattr(shared_plates, "set_up", slow)
    async with Shared().running() as shared:
        shared.send_info("left", info())
        shared.send("left", signals(0))
        await until(began.is_set)
        for seq in (1, 2):
            shared.send("left", signals(seq))
        assert shared.plates.health()["left"].skipped == 1
        shared.withdraw("left")
        shared.send_info("left", info())
        assert shared.plates.health()["left"].waiting == 0
        shared.send("left", signals(3))
        may_end.set()
        await until(lambda: shared.plates.health()["left"].decoded == 1)
        assert shared.decoded == [("left", 3)]
        account = shared.plates.health()["left"]
        assert (account.received, account.skipped, account.unusable, account.waiting) == (1, 0, 0, 0)


async def test_beyond_its_places_only_silent_plates_give_way(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now_s=0.0)
    for module in (plate, shared_plates):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    monkeypatch.setattr(shared_plates, "PLATES_MAX", 3)
    shared = Shared()
    for name in ("a", "b", "c"):
        shared.send_info(name, info())
        clock.now_s += 1.0
    clock.now_s = 60.0
    shared.send("a", signals(0))
    for name in ("d", "e"):
        shared.send_info(name, info())
    assert set(shared.plates.health()) == {"a", "b", "c"}
    assert "d: is beyond 3 plates" in shared.plates.condition()[1].text
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    clock.now_s = 61.5
    shared.send_info("e", info())
    assert set(shared.plates.health()) == {"a", "c", "e"}
    assert "e: is beyond" not in shared.plates.condition()[1].text
    shared.send_info("f", info())
    assert set(shared.plates.health()) == {"a", "c", "e"}
    shared.withdraw("c")
    shared.send_info("f", info())
    assert set(shared.plates.health()) == {"a", "e", "f"}
