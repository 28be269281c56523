"""A daemon whose wall clock jumps: from 1970 to the present, past 2038 and back; frames and contacts go on."""

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from brokers import Mosquitto
from observer import Observer, observe
from scenarios import IDEAL, touch_text
from service_bench import Bench

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.recording.reader import open_recording
from resonator_daemon.daemon.service.config_store import ConfigStore
from resonator_daemon.daemon.service.daemon import Service

S = 1_000_000_000
DAY_NS = 86_400 * S
EPOCH_NS = 60 * S  # a computer without a clock of its own, a minute after it was switched on
LATE_2038_NS = 2**31 * S + DAY_NS
YEAR_2105_NS = 2**32 * S + DAY_NS  # seconds do not fit into 32 bits, with a sign or without
PRESSED = IDEAL + touch_text(0.5, 1.0, 600.0, site=7)  # never let go, however long a busy computer takes


class WallClock:
    """UTC as the test wants it; everything else about time is the computer's own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._real = time.time_ns
        self._ahead_ns = 0
        monkeypatch.setattr(time, "time_ns", lambda: self._real() + self._ahead_ns)
        monkeypatch.setattr(time, "time", lambda: (self._real() + self._ahead_ns) * 1e-9)

    def set(self, utc_ns: int | None) -> None:
        """Set it; None: to what it really is."""
        self._ahead_ns = 0 if utc_ns is None else utc_ns - self._real()


async def newer_than(observer: Observer, path: str, utc_ns: int) -> dict[str, Any]:
    """Wait for a message of what was measured, or made, within the hour that then began."""
    topic = f"resonator/hand/{path}"

    def said() -> bool:
        payloads = observer.payloads(topic)
        return bool(payloads) and 0 <= int(payloads[-1]["t_ns"]) - utc_ns < 3600 * S

    await observer.until(said)
    return dict(observer.payloads(topic)[-1])


async def test_jumps_of_the_wall_clock_are_jumps_of_time_stamps_and_nothing_else(
    tmp_path: Path, mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, clock = Bench(tmp_path, mosquitto.url), WallClock(monkeypatch)
    store = ConfigStore(bench.recording_config("file_max_minutes = 0.005"), tmp_path / "last-good")
    present_ns = time.time_ns()
    clock.set(EPOCH_NS)
    async with (
        observe(mosquitto.url, "resonator/hand/#") as observer,
        bench.emulated(scenario=bench.scenario(PRESSED)),
        bench.running(Service(store)) as running,
    ):
        files = []
        for utc_ns in (EPOCH_NS, present_ns, LATE_2038_NS, YEAR_2105_NS, present_ns, EPOCH_NS):
            clock.set(utc_ns)
            await newer_than(observer, "forces", utc_ns)
            last = await newer_than(observer, "health", utc_ns)
            files.append(last["recording"]["files"])
        account = running.link_counters
        assert account.connections == 1
        assert account.clock_restarts == 0
    forces = observer.payloads("resonator/hand/forces")
    assert all(late["seq"] > early["seq"] for early, late in pairwise(forces))  # a busy computer skips some
    assert all(int(late["board_ticks"]) > int(early["board_ticks"]) for early, late in pairwise(forces))
    links = observer.payloads("resonator/hand/state/link")
    if "stalled" not in {link["state"] for link in links}:  # the board of a busy machine is late, as without any jump
        assert account.clock_outliers == 0
        events = observer.payloads("resonator/hand/contacts/event")
        assert [event.get("reason_code") for event in events] == [None, "stopped"]  # onset, and release at the end
        assert not [link for link in links if "last_outage" in link]
    assert files == sorted(files)
    assert files[-1] > files[0] > 0
    recordings = sorted((bench.folder / "recordings").iterdir())
    assert {path.name[5:9] for path in recordings} == {"1970", time.strftime("%Y", time.gmtime()), "2038", "2106"}
    plate = load_plate("quartz16")
    for path in recordings:
        with open_recording(str(path), plate) as recording:
            assert sum(1 for _ in recording.entries()) > 0, path
