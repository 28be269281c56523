"""Rates, losses and vital signs of the daemon, against a clock and a process that the test controls."""

import asyncio
import json
import math
import os
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import status_samples

from resonator_daemon.monitoring import health
from resonator_daemon.monitoring.health import HealthMonitor
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.payloads import DecoderProcessInfo, Health, LatencyInfo, Lost
from resonator_daemon.session.counters import LinkCounters

MESSAGES = status_samples.health().messages
LATENCY = {"forces": LatencyInfo(bounds_ms=(1.0, 2.0), counts=(7, 3, 1))}
RECORDING = status_samples.RECORDING
COMMANDS = {"done": 2, "denied": 1}
HEADER = {"seq": 0, "daemon_boot_id": "9f3c", "board_boot_id": None, "t_ns": 1, "t_unc_ns": 0, "lost": Lost(damaged=9)}
DECODER = DecoderProcessInfo(
    pid=3, restarts={}, decoded=5, skipped={"newer_frame": 10, "too_old": 7}, waiting=1, cpu_percent=1.0, rss_mb=2.0
)


class Process:
    """A process of 92 MB, busy by 0.5 % more in every interval; the first of all measures nothing."""

    def __init__(self, pid: int | None = None) -> None:
        self._asked = 0

    def cpu_percent(self) -> float:
        self._asked += 1
        return 20.0 + 0.5 * (self._asked - 1) if self._asked > 1 else 0.0

    def memory_info(self) -> Any:
        return SimpleNamespace(rss=92_000_000)

    def num_threads(self) -> int:
        return 5

    def num_fds(self) -> int:
        return 23


class Machine:
    """What a monitor sees of the world."""

    def __init__(self) -> None:
        self.now_s = 5000.0

    def health(self, monitor: HealthMonitor, **link: int) -> Health:
        return monitor.report(HEADER, LinkCounters(**link), MESSAGES, 1.5, {"edges": 3}, LATENCY, RECORDING, COMMANDS)  # type: ignore[arg-type]


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    machine = Machine()
    monkeypatch.setattr(health, "time", SimpleNamespace(monotonic=lambda: machine.now_s))
    monkeypatch.setattr(health, "psutil", SimpleNamespace(Process=Process, Error=Exception))
    return machine


async def test_rates_are_those_since_the_last_call(machine: Machine) -> None:
    monitor = HealthMonitor()
    made = []
    for seconds, frames in ((2.0, 2000), (0.5, 2450), (0.0, 2450), (1.0, 3450)):
        machine.now_s += seconds
        made.append(machine.health(monitor, frames=frames))
    assert [each.frame_rate_hz for each in made] == pytest.approx([1000.0, 900.0, 0.0, 1000.0])
    assert [each.uptime_s for each in made] == pytest.approx([2.0, 2.5, 2.5, 3.5])
    assert [each.cpu_percent for each in made] == [20.5, 21.0, 21.5, 22.0]
    assert {each.rss_mb for each in made} == {92.0}


async def test_every_byte_has_one_fate(machine: Machine) -> None:
    made = machine.health(
        HealthMonitor(),
        bytes_received=11111,
        bytes_accepted=10000,
        bytes_other_version=1000,
        bytes_echo=100,
        bytes_discarded=10,
        bytes_waiting=1,
    )
    assert made.bytes_in == 11111 == sum(made.bytes_by_fate.values())
    assert made.bytes_by_fate == {
        "accepted": 10000,
        "other_version": 1000,
        "own_direction": 100,
        "discarded": 10,
        "waiting": 1,
    }


async def test_vitals_are_the_body_of_a_health_message(machine: Machine) -> None:
    monitor = HealthMonitor()
    machine.now_s += 1.0
    made = monitor.report(
        HEADER,
        LinkCounters(frames=1000, parts_lost=4),
        MESSAGES,
        math.nan,
        {"edges": 3},
        LATENCY,
        RECORDING,
        COMMANDS,
        DECODER,
    )
    payload = json.loads(encode(made))
    expected = {
        "uptime_s": 1.0,
        "frames": 1000,
        "frame_rate_hz": 1000.0,
        "parts_lost": 4,
        "frames_not_decoded": 17,
        "records_unusable": {"edges": 3},
        "clock_drift_ppm": None,  # not known yet
        "cpu_percent": 20.5,
        "tasks": 1,
        "threads": 5,
        "file_descriptors": 23,
        "latency": {"forces": {"bounds_ms": [1.0, 2.0], "counts": [7, 3, 1]}},
        "recording": RECORDING.model_dump(mode="json"),
        "commands": COMMANDS,
        "messages": MESSAGES.model_dump(),
    }
    assert payload | expected == payload


async def test_what_is_held_is_counted_and_what_is_let_go_is_not() -> None:
    before = health_of_now()
    release = threading.Event()
    thread = threading.Thread(target=release.wait)
    thread.start()
    task = asyncio.create_task(asyncio.Event().wait())
    descriptors = os.pipe()
    held = health_of_now()
    assert held.threads == before.threads + 1
    assert held.tasks == before.tasks + 1
    assert held.file_descriptors == before.file_descriptors + 2
    release.set()
    thread.join()
    wait_for_the_kernel_to_let_go(thread)
    task.cancel()
    await asyncio.wait([task])
    for descriptor in descriptors:
        os.close(descriptor)
    after = health_of_now()
    assert (after.threads, after.tasks, after.file_descriptors) == (
        before.threads,
        before.tasks,
        before.file_descriptors,
    )


def wait_for_the_kernel_to_let_go(thread: threading.Thread) -> None:
    while Path(f"/proc/self/task/{thread.native_id}").exists():  # for a moment after it was joined
        os.sched_yield()


def health_of_now() -> Health:
    return HealthMonitor().report(HEADER, LinkCounters(), MESSAGES, 0.0, {}, {}, RECORDING, {})
