"""A busy computer is told from a bad link: what its lateness explains is nobody else's fault."""

import ctypes
from pathlib import Path

import pytest
from made_up_host import MadeUpHost

from resonator_daemon.doctor.host import Load


@pytest.mark.parametrize(("idle", "busy"), [(14, True), (16, False)])
def test_a_computer_without_idle_time_is_busy(tmp_path: Path, idle: int, busy: bool) -> None:
    computer = MadeUpHost(tmp_path)
    computer.write("proc/stat", "cpu  1000 0 0 5000 0 0 0 0 0 0\ncpu0 1 1 1 1")
    load = Load(computer.host())
    assert load.busy() == ""
    computer.write("proc/stat", f"cpu  {1100 - idle} 0 0 {5000 + idle - 5} 5 0 0 0 0 0\ncpu0 1 1 1 1")
    assert load.busy().startswith("this computer is busy: its processors") is busy


def test_a_program_that_was_left_waiting_has_seen_a_busy_computer(tmp_path: Path) -> None:
    with Load(MadeUpHost(tmp_path).host()) as load:
        halt = ctypes.PyDLL(None).usleep  # keeps the interpreter's lock: no thread of this program goes on meanwhile
        halt(80_000)
    assert load.busy().startswith("this computer is busy: it let a program that was to run wait for")
