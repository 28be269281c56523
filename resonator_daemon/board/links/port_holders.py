"""Processes that hold a port open, from Linux's /proc."""

import os
import stat
from pathlib import Path
from typing import NamedTuple

PROC = Path("/proc")
_PTY_MAJORS = range(136, 144)


class Holder(NamedTuple):
    """A process that has the port open."""

    pid: int
    name: str
    locks: bool  # by flock

    def __str__(self) -> str:
        return f"{self.name} (pid {self.pid})"


class Holders(NamedTuple):
    """Who holds a port; `all_seen` is false where there are processes that this user may not look into."""

    processes: tuple[Holder, ...]
    all_seen: bool

    def __str__(self) -> str:
        """Name those that locked the port, else all: an emulator holds its own terminal, too."""
        locking = [holder for holder in self.processes if holder.locks]
        return " and ".join(str(holder) for holder in locking or self.processes)


def port_holders(path: str, proc: Path = PROC) -> Holders:
    """Return the processes that hold the character device at `path`, this one included."""
    try:
        port = os.stat(path)
    except OSError:
        return Holders((), True)
    if not stat.S_ISCHR(port.st_mode):
        return Holders((), True)
    locking = _locking(port, proc)
    found: list[Holder] = []
    all_seen = True
    for process in proc.glob("[0-9]*"):
        try:
            with os.scandir(process / "fd") as descriptors:
                holds = any(_is_open(descriptor, port) for descriptor in descriptors)
            if holds:
                pid = int(process.name)
                name = (process / "comm").read_text(errors="replace").strip()
                found.append(Holder(pid, name, pid in locking))
        except PermissionError:
            all_seen = False
        except OSError:
            continue  # it ended meanwhile
    return Holders(tuple(sorted(found)), all_seen)


def is_pseudo_terminal(path: str) -> bool:
    """Return whether `path` is a pseudo-terminal, whose other side may well hold it too."""
    try:
        return os.major(os.stat(path).st_rdev) in _PTY_MAJORS
    except OSError:
        return False


def _locking(port: os.stat_result, proc: Path) -> set[int]:
    where = f"{os.major(port.st_dev):02x}:{os.minor(port.st_dev):02x}:{port.st_ino}"
    try:
        locks = [line.split() for line in (proc / "locks").read_text().splitlines()]
    except OSError:
        return set()
    return {int(lock[4]) for lock in locks if len(lock) > 5 and lock[1] == "FLOCK" and lock[5] == where}


def _is_open(descriptor: os.DirEntry[str], port: os.stat_result) -> bool:
    try:
        held = descriptor.stat()
    except FileNotFoundError:
        return False  # closed meanwhile
    if held.st_rdev != port.st_rdev or not stat.S_ISCHR(held.st_mode):
        return False
    # Each container numbers pseudo-terminals of its own.
    return held.st_dev == port.st_dev or os.major(port.st_rdev) not in _PTY_MAJORS
