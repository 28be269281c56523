"""Clock, disk, service and load: what the computer itself may lack."""

import ctypes
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from made_up_host import MadeUpHost

from resonator_daemon.base.host import load
from resonator_daemon.board.config.tables import Recording
from resonator_daemon.tools.doctor.finding import Outcome
from resonator_daemon.tools.doctor.host_checks import BusyCheck, Host, check_clock, check_disk, check_service

NOW_S = 1.78e9
SOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"


@pytest.fixture
def computer(tmp_path: Path) -> MadeUpHost:
    made = MadeUpHost(tmp_path)
    made.write(SOURCE, "tsc")
    return made


def clock(host: Host, now_s: float = NOW_S, synchronised: bool | None = True) -> dict[str, Outcome]:
    return {finding.id: finding.outcome for finding in check_clock(host, lambda: now_s, lambda: synchronised)}


def test_a_clock_that_is_well(computer: MadeUpHost) -> None:
    assert set(clock(computer.host()).values()) == {Outcome.OK}


def test_a_slow_clock_source_is_a_warning(computer: MadeUpHost) -> None:
    computer.write(SOURCE, "hpet")
    assert clock(computer.host())["clock.source"] is Outcome.WARNING


def test_a_clock_at_1970_is_a_fault(computer: MadeUpHost) -> None:
    assert clock(computer.host(), now_s=12.0)["clock.date"] is Outcome.FAULT


@pytest.mark.parametrize(("kept", "outcome"), [(False, Outcome.WARNING), (None, Outcome.NOT_CHECKED)])
def test_a_clock_that_nobody_keeps_is_a_warning(computer: MadeUpHost, kept: bool | None, outcome: Outcome) -> None:
    assert clock(computer.host(), synchronised=kept)["clock.synchronised"] is outcome


def recording(directory: Path, **keys: float) -> Recording:
    return Recording.model_construct(**{"directory": directory, "min_free_mb": 1.0, "max_total_mb": 1.0} | keys)


def test_a_disk_with_room_is_well(tmp_path: Path) -> None:
    findings = list(check_disk(tmp_path / "made" / "later", recording(tmp_path / "recordings"), "hand"))
    assert [finding.outcome for finding in findings] == [Outcome.OK] * 3
    assert not (tmp_path / "made").exists()


def disk_of(monkeypatch: pytest.MonkeyPatch, free_mb: int) -> None:
    monkeypatch.setattr(os, "statvfs", lambda _path: SimpleNamespace(f_bavail=free_mb, f_frsize=1_000_000))


def test_too_little_room_is_a_fault_and_a_budget_beyond_the_disk_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk_of(monkeypatch, 60)
    of = recording(tmp_path, min_free_mb=20.0, max_total_mb=50.0)
    little = {f.id: f.outcome for f in check_disk(tmp_path, of, "hand")}
    assert little == {"disk.state": Outcome.OK, "disk.recordings": Outcome.OK, "disk.budget": Outcome.WARNING}
    disk_of(monkeypatch, 40)
    less = {f.id: f.outcome for f in check_disk(tmp_path, recording(tmp_path, min_free_mb=41.0), "hand")}
    assert less["disk.state"] is less["disk.recordings"] is Outcome.FAULT


def test_a_directory_that_cannot_be_written_is_a_fault(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    findings = {finding.id: finding for finding in check_disk(tmp_path / "file", recording(Path("/proc/none")), "hand")}
    assert findings["disk.state"].outcome is Outcome.FAULT
    assert findings["disk.recordings"].outcome is Outcome.FAULT
    assert findings["disk.budget"].outcome is Outcome.NOT_CHECKED


def test_recordings_that_are_there_count_for_the_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk_of(monkeypatch, 60)
    room = recording(tmp_path, min_free_mb=20.0, max_total_mb=42.0)

    def budget(name: str | None = "hand") -> Outcome:
        return {f.id: f.outcome for f in check_disk(tmp_path, room, name)}["disk.budget"]

    assert budget() is Outcome.WARNING
    for others in ("old.mcap", "foot-20260101T000000.000Z.mcap", "hand-left-20260101T000000.000Z.mcap"):
        (tmp_path / others).write_bytes(bytes(2_000_000))  # which do not give way
    assert budget() is Outcome.WARNING
    (tmp_path / "hand-20260101T000000.000Z.mcap").write_bytes(bytes(2_000_000))
    assert budget() is Outcome.OK
    assert budget(None) is Outcome.WARNING


def test_without_systemd_or_for_a_configuration_of_ones_own_no_unit_is_asked_for(computer: MadeUpHost) -> None:
    ours = Path("/etc/resonatord/hand.toml")
    assert [f.outcome for f in check_service(ours, computer.host())] == [Outcome.NOT_CHECKED]
    (computer.root / "run/systemd/system").mkdir(parents=True)
    assert [f.outcome for f in check_service(Path("hand.toml"), computer.host())] == [Outcome.NOT_CHECKED]


def test_a_service_needs_its_unit_and_its_rules(computer: MadeUpHost) -> None:
    ours = Path("/etc/resonatord/hand.toml")
    (computer.root / "run/systemd/system").mkdir(parents=True)
    assert [f.id for f in check_service(ours, computer.host()) if f.outcome is Outcome.WARNING] == ["service.unit"]
    computer.write("etc/systemd/system/resonatord@.service", "")
    assert [f.id for f in check_service(ours, computer.host()) if f.outcome is Outcome.WARNING] == ["service.rules"]
    computer.write("usr/lib/udev/rules.d/70-resonatord.rules", "")
    assert {f.outcome for f in check_service(ours, computer.host())} == {Outcome.OK}


@pytest.mark.parametrize(("waited_ns", "busy"), [(64_000, False), (66_000, True)])
def test_a_computer_whose_programs_wait_for_processors_is_busy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waited_ns: int, busy: bool
) -> None:
    computer, schedstat = MadeUpHost(tmp_path), "proc/self/task/7/schedstat"
    now_ns = 10**12
    monkeypatch.setattr(load, "time", SimpleNamespace(monotonic_ns=lambda: now_ns))
    computer.write(schedstat, "1000 1000 5")
    measured = BusyCheck(computer.host())
    assert measured.reason() == ""
    now_ns += 10**9
    computer.write(schedstat, f"{101_000 - waited_ns} {1000 + waited_ns} 9")
    assert bool(measured.reason()) is busy


def test_a_computer_that_halts_a_program_is_busy(tmp_path: Path) -> None:
    with BusyCheck(MadeUpHost(tmp_path).host()) as measured:
        halt = ctypes.PyDLL(None).usleep  # keeps the interpreter's lock: no thread of this program goes on meanwhile
        halt(80_000)
    assert measured.reason()
