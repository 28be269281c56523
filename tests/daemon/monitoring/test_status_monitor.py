"""Health and ages of the status, against clocks, a process and a computer that the test controls."""

import asyncio
import time
from types import SimpleNamespace
from typing import Any

import pytest
import status_samples
from example_messages import header

from resonator_daemon.base.host.load import HostLoad
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.session.frames import LinkCounters
from resonator_daemon.daemon.monitoring import status
from resonator_daemon.daemon.monitoring.status import Status, StatusMonitor
from resonator_daemon.mqtt.payloads import Condition, Health, Lost

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
    info = info.model_copy(update={"skipped": {"not_ready": 178, "newer_frame": 4, "decoder_ended": 2}})
    made = StatusMonitor().health(HEADER, LinkCounters(), HostLoad(), info, **OTHER)
    assert (made.frames_not_decoded, made.decoder) == (6, info)


S = 1_000_000_000
IN_1970_NS = 60 * S


class Clocks:
    """Both clocks as the test wants them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.monotonic_s, self.utc_ns = 5000.0, IN_1970_NS
        monkeypatch.setattr(time, "monotonic", lambda: self.monotonic_s)
        monkeypatch.setattr(time, "time_ns", lambda: self.utc_ns)

    def pass_s(self, seconds: float) -> None:
        self.monotonic_s += seconds
        self.utc_ns += round(seconds * S)


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    return Clocks(monkeypatch)


def status_at(since_ns: int, **changed: Any) -> Status:
    """A status whose moments are all the same."""
    sample = status_samples.status()
    state = status_samples.state(Condition.ONLINE).model_copy(update={"since_t_ns": since_ns})
    moments = {
        "config": sample.config.model_copy(update={"loaded_t_ns": since_ns}),
        "daemon": state.model_copy(update={"connected_t_ns": since_ns}),
        "link": state.model_copy(
            update={"last_outage": status_samples.outage().model_copy(update={"end_t_ns": since_ns})}
        ),
        "sensor": state,
        "recording": sample.recording.model_copy(update={"since_t_ns": since_ns}),
    }
    return sample.model_copy(update=moments | changed)


def ages_of(monitor: StatusMonitor, status: Status) -> dict[str, float]:
    return monitor.with_ages(status).ages_s


NAMES = {"started", "config", "daemon", "link", "sensor", "outage", "connected", "recording"}


@pytest.mark.parametrize("set_to_ns", [status_samples.NOW_NS, 0, IN_1970_NS + 3600 * S, None])
def test_a_wall_clock_that_is_set_changes_no_age(clocks: Clocks, set_to_ns: int | None) -> None:
    monitor, status = StatusMonitor(), status_at(clocks.utc_ns)
    clocks.pass_s(0.75)
    assert ages_of(monitor, status) == pytest.approx(dict.fromkeys(NAMES, 0.75))
    if set_to_ns is not None:
        clocks.utc_ns = set_to_ns
    clocks.pass_s(120.0)
    assert ages_of(monitor, status) == pytest.approx(dict.fromkeys(NAMES, 120.75))


@pytest.mark.parametrize("moment_ns", [status_samples.NOW_NS, 0])
def test_a_moment_by_another_clock_than_now_counts_from_when_it_is_seen(clocks: Clocks, moment_ns: int) -> None:
    monitor = StatusMonitor()
    clocks.pass_s(100.0)
    clocks.utc_ns = status_samples.NOW_NS - 3600 * S
    assert ages_of(monitor, status_at(moment_ns)) == pytest.approx(dict.fromkeys(NAMES, 0.0) | {"started": 100.0})
    clocks.pass_s(2.0)
    assert ages_of(monitor, status_at(moment_ns)) == pytest.approx(dict.fromkeys(NAMES, 2.0) | {"started": 102.0})


def test_a_state_since_the_start_is_as_old_as_the_daemon_however_late_it_is_seen(clocks: Clocks) -> None:
    monitor, started_ns = StatusMonitor(), clocks.utc_ns
    clocks.pass_s(300)
    found = ages_of(monitor, status_at(clocks.utc_ns, started_t_ns=started_ns, daemon=status_at(started_ns).daemon))
    assert (found["started"], found["daemon"], found["link"]) == pytest.approx((300, 300, 0))


def test_a_new_moment_begins_anew_and_nothing_is_older_than_the_daemon(clocks: Clocks) -> None:
    monitor = StatusMonitor()
    clocks.pass_s(3.0)
    assert set(ages_of(monitor, status_at(clocks.utc_ns - 9 * S)).values()) == {3.0}
    clocks.pass_s(50.0)
    later = status_at(clocks.utc_ns - S // 2, sensor=None)
    assert ages_of(monitor, later) == pytest.approx(dict.fromkeys(NAMES - {"sensor"}, 0.5) | {"started": 53.0})
