"""Many plates in one process: whose frame it is, what is said of them all, and how many there may be."""

import logging
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

import pytest
from decoder_bench import incoming, info, signals, until
from observer import running_task

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.board.config.tables import Decoding
from resonator_daemon.daemon.remote_decoding import shared_plates
from resonator_daemon.daemon.remote_decoding.shared_plates import SharedPlates
from resonator_daemon.estimate.surface.skin import DecodingOptions
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import GridInfo, Info, Message, Signals

CONFIG = DecoderConfig(decoding=Decoding(plates=("+",), group="touch"))
LINEAR = DecodingOptions(contact_physics=False, background=False)


class Shared:
    """Shared plates, and what they have published."""

    def __init__(self) -> None:
        self.published: list[tuple[str, str, Any]] = []
        self.plates = SharedPlates(CONFIG, LINEAR, "host-1", self._publish)
        self._info, self._signals = self.plates.subscriptions

    def _publish(self, plate: str, topic: Any, message: Message) -> None:
        self.published.append((plate, topic.path, message))

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
    monkeypatch.setattr(shared_plates, "WAITS_AFTER_S", 0.2)
    async with Shared().running() as shared:
        assert shared.plates.condition() == NOTHING
        shared.send_info("left", info())
        shared.send_info("right", info(skin=None))
        shared.send("left", signals(0))
        problem = "right: has no skin to decode; waits for another plate of this name"
        decoding = Reason(ReasonCode.DECODING, f"signals of 1 plates are decoded; {problem}")
        await until(lambda: shared.plates.condition() == ("online", decoding))
        silent = Reason(ReasonCode.NO_SIGNALS, f"{NOTHING[1].text}; {problem}")
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
        assert [(plate, path) for plate, path, _ in shared.published].count(("left", "decoded")) == 1
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
        assert [message.seq for _, path, message in shared.published if path == "decoded"] == [3]
        account = shared.plates.health()["left"]
        assert (account.received, account.skipped, account.unusable, account.waiting) == (1, 0, 0, 0)


async def test_beyond_its_places_only_silent_plates_give_way(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now_s=0.0)
    monkeypatch.setattr(shared_plates, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    monkeypatch.setattr(shared_plates, "PLATES_MAX", 3)
    shared = Shared()
    for name in ("a", "b", "c"):
        assert "no more are taken" not in shared.plates.condition()[1].text
        shared.send_info(name, info())
        clock.now_s += 1.0
    clock.now_s = 60.0
    shared.send("a", signals(0))
    for name in ("d", "e"):
        shared.send_info(name, info())
    assert set(shared.plates.health()) == {"a", "b", "c"}
    assert "3 plates are known, no more are taken; d: is beyond 3 plates" in shared.plates.condition()[1].text
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    clock.now_s = 61.5
    shared.send_info("e", info())
    assert set(shared.plates.health()) == {"a", "c", "e"}
    assert "e: is beyond" not in shared.plates.condition()[1].text
    shared.send_info("f", info())
    assert set(shared.plates.health()) == {"a", "c", "e"}
    shared.withdraw("c")
    assert "no more are taken" not in shared.plates.condition()[1].text
    shared.send_info("f", info())
    assert set(shared.plates.health()) == {"a", "e", "f"}
