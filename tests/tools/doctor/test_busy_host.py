"""A busy computer is distinguished from a bad link: delays that it explains are no fault of the link."""

import ctypes
from pathlib import Path
from types import SimpleNamespace

import pytest
from made_up_host import MadeUpHost

from resonator_daemon.base.host import load
from resonator_daemon.tools.doctor.host_checks import BusyCheck


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
