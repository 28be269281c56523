"""Rates, losses and vital signs of the daemon, against a clock and a process that the test controls."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
import status_samples
from example_messages import header

from resonator_daemon.base.host.load import HostLoad
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.session.counters import LinkCounters
from resonator_daemon.daemon.monitoring import status
from resonator_daemon.daemon.monitoring.status import StatusMonitor
from resonator_daemon.mqtt.payloads import Health, Lost

OTHER = status_samples.health().model_dump(
    include={"messages", "clock_drift_ppm", "records_unusable", "latency", "recording", "commands"}
)
HEADER = header(lost=Lost(damaged=9))


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
        self.load = HostLoad()

    def health(self, monitor: StatusMonitor, **link: int) -> Health:
        return monitor.health(HEADER, LinkCounters(**link), self.load, **OTHER)


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    machine = Machine()
    monkeypatch.setattr(status, "time", SimpleNamespace(monotonic=lambda: machine.now_s))
    monkeypatch.setattr("resonator_daemon.base.host.load.psutil.Process", Process)
    return machine


async def test_rates_are_those_since_the_last_call(machine: Machine) -> None:
    monitor = StatusMonitor()
    made = []
    for seconds, frames in ((2.0, 2000), (0.5, 2450), (0.0, 2450), (1.0, 3450)):
        machine.now_s += seconds
        made.append(machine.health(monitor, frames=frames))
    assert [each.frame_rate_hz for each in made] == pytest.approx([1000.0, 900.0, 0.0, 1000.0])
    assert [each.uptime_s for each in made] == pytest.approx([2.0, 2.5, 2.5, 3.5])
    assert [each.cpu_percent for each in made] == [20.5, 21.0, 21.5, 22.0]
    assert {(each.rss_mb, each.threads, each.file_descriptors) for each in made} == {(92.0, 5, 23)}
    assert {each.tasks for each in made} == {len(asyncio.all_tasks())}


async def test_a_busy_computer_has_its_code_and_the_share_of_waiting_time(machine: Machine) -> None:
    monitor = StatusMonitor()
    machine.load = HostLoad(0, 83.0, Reason(ReasonCode.COMPUTER_BUSY, "busy"))
    made = machine.health(monitor)
    assert (made.reason_code, made.processor_wait_percent) == ("computer_busy", 83.0)
    machine.load = HostLoad(0, 41.0)
    made = machine.health(monitor)
    assert (made.reason_code, made.processor_wait_percent) == (None, 41.0)


async def test_frames_before_the_decoder_is_ready_are_not_lost() -> None:
    info = status_samples.health().decoder
    assert info is not None
    info = info.model_copy(update={"skipped": {"not_ready": 178, "newer_frame": 4, "decoder_ended": 2}})
    made = StatusMonitor().health(HEADER, LinkCounters(), HostLoad(), info, **OTHER)
    assert (made.frames_not_decoded, made.decoder) == (6, info)
