"""Clock, disk and load: what the computer itself may lack."""

import ctypes
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from made_up_host import MadeUpHost

from resonator_daemon.base.host import load
from resonator_daemon.board.config.tables import Recording
from resonator_daemon.tools.doctor.finding import Outcome
from resonator_daemon.tools.doctor.host_checks import BusyCheck, check_clock, check_disk


@pytest.mark.parametrize(
    ("kept", "outcome"), [(True, Outcome.OK), (False, Outcome.WARNING), (None, Outcome.NOT_CHECKED)]
)
def test_a_clock_that_nobody_keeps_is_a_warning(kept: bool | None, outcome: Outcome) -> None:
    assert [finding.outcome for finding in check_clock(lambda: kept)] == [outcome]


def recording(directory: Path, **keys: float) -> Recording:
    return Recording.model_construct(**{"directory": directory, "min_free_mb": 1.0} | keys)


def test_a_disk_with_room_is_well(tmp_path: Path) -> None:
    findings = list(check_disk(tmp_path / "made" / "later", recording(tmp_path / "recordings")))
    assert [finding.outcome for finding in findings] == [Outcome.OK] * 2
    assert not (tmp_path / "made").exists()


def test_too_little_room_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "statvfs", lambda _path: SimpleNamespace(f_bavail=40, f_frsize=1_000_000))
    found = {f.id: f.outcome for f in check_disk(tmp_path, recording(tmp_path, min_free_mb=40.0))}
    assert found == {"disk.state": Outcome.FAULT, "disk.recordings": Outcome.OK}


def test_a_directory_that_cannot_be_written_is_a_fault(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    findings = {finding.id: finding for finding in check_disk(tmp_path / "file", recording(Path("/proc/none")))}
    assert findings["disk.state"].outcome is Outcome.FAULT
    assert findings["disk.recordings"].outcome is Outcome.FAULT


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
