"""Who holds a port, from this system's own /proc and from made-up ones."""

import fcntl
import os
import pty
from collections.abc import Iterator
from pathlib import Path

import pytest

from resonator_daemon.board.links.port_holders import Holder, Holders, is_pseudo_terminal, port_holders

OWN_NAME = Path("/proc/self/comm").read_text().strip()


@pytest.fixture
def slave() -> Iterator[int]:
    master, slave = pty.openpty()
    yield slave
    os.close(master)
    os.close(slave)


def test_a_port_that_this_process_holds_is_told_with_and_without_a_lock(slave: int, tmp_path: Path) -> None:
    path = os.ttyname(slave)
    with open(tmp_path / "other", "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)  # a lock on something else is none on the port
        assert port_holders(path).processes == (Holder(os.getpid(), OWN_NAME, locks=False),)
    fcntl.flock(slave, fcntl.LOCK_EX)
    assert port_holders(path).processes == (Holder(os.getpid(), OWN_NAME, locks=True),)


def test_a_port_that_nobody_holds_a_file_and_nothing_have_no_holders(tmp_path: Path) -> None:
    (tmp_path / "notes").touch()
    with open(tmp_path / "notes"):
        for path in (tmp_path / "notes", tmp_path / "none"):
            assert port_holders(str(path)) == Holders((), True)


def test_processes_without_permission_are_reported(slave: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for pid in ("7", "8", "self"):
        (tmp_path / pid / "fd").mkdir(parents=True)
    (tmp_path / "8" / "fd" / "3").symlink_to(os.ttyname(slave))
    (tmp_path / "8" / "comm").write_text("minicom\n")
    (tmp_path / "9").mkdir()  # has just ended
    real = os.scandir

    def scan(path: Path) -> object:
        if path.parent.name == "7":
            raise PermissionError
        return real(path)

    monkeypatch.setattr(os, "scandir", scan)
    assert port_holders(os.ttyname(slave), tmp_path) == Holders((Holder(8, "minicom", locks=False),), False)


def test_pseudo_terminals_are_told_from_other_ports(slave: int, tmp_path: Path) -> None:
    assert is_pseudo_terminal(os.ttyname(slave))
    assert not is_pseudo_terminal("/dev/null")
    assert not is_pseudo_terminal(str(tmp_path / "none"))
