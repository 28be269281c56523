"""The computer that is checked: its load, its clock, the space on its disk."""

import ctypes
import errno
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.host.load import BUSY_PERCENT, LoadMeter, busy_reason
from resonator_daemon.board.config.tables import Recording
from resonator_daemon.tools.doctor.finding import Amount, Check, Finding, make_check

_SYNCHRONISED: Final = make_check("clock.synchronised")
_STATE: Final = make_check("disk.state")
_RECORDINGS: Final = make_check("disk.recordings")

_PULSE_S: Final = 0.005
_HALT_S: Final = 0.03  # a program that runs at once is late by a few ms; boards count as silent after some 50 ms
_TIMEX_BYTES: Final = 208  # struct timex of 64-bit Linux; this much is enough for all others
_TIME_ERROR: Final = 5  # what adjtimex returns of a clock that is not synchronised
_STATE_MB: Final = 50.0
_MB: Final = 1e6
_RULE_PLACES: Final = ("/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")


def _may_use(path: Path) -> bool:
    return os.access(path, os.R_OK | os.W_OK)


@dataclass(frozen=True)
class Host:
    """Where /sys, /proc, /etc and /run are, and whether a file may be read and written here."""

    root: Path = Path("/")
    may_use: Callable[[Path], bool] = _may_use

    def at(self, path: str | Path) -> Path:
        """Return where an absolute path of the computer is."""
        return self.root / str(path).lstrip("/")

    def text(self, path: str | Path) -> str | None:
        """Return a small file's content without white space around it; None where there is none to be read."""
        try:
            return self.at(path).read_text(errors="replace").strip()
        except OSError:
            return None

    def running(self, name: str) -> bool:
        """Whether a process of this name runs."""
        return any(self.text(f"/proc/{directory.name}/comm") == name for directory in self.at("/proc").glob("[0-9]*"))

    def rules(self, word: str) -> list[Path]:
        """Return the files of udev rules with this word in their names."""
        return [file for place in _RULE_PLACES for file in self.at(place).glob(f"*{word}*.rules")]


class BusyCheck:
    """Whether this computer is busy while the block runs: waits for processors, and halts.

    The processor times of a virtual machine do not contain its waits for its host. A thread that sleeps repeatedly
    for a moment, and wakes late, detects them.
    """

    def __init__(self, host: Host) -> None:
        self._meter = LoadMeter(host.at("/proc"))
        self._halted_s = 0.0
        self._ended = threading.Event()
        self._pulse = threading.Thread(target=self._watch, name="pulse", daemon=True)

    def __enter__(self) -> Self:
        self._pulse.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._pulse.join()

    def reason(self) -> str:
        """Return a sentence if the computer was busy, otherwise an empty text."""
        if self._halted_s > _HALT_S:
            return (
                f"this computer is busy: a program that could run waited for {1e3 * self._halted_s:.0f} ms; "
                f"at most {1e3 * _HALT_S:.0f} ms are accepted"
            )
        sample = self._meter.sample()
        return busy_reason(sample).text if min(sample) >= BUSY_PERCENT else ""

    def _watch(self) -> None:
        ended = False
        while not ended:
            due_s = time.monotonic() + _PULSE_S
            ended = self._ended.wait(_PULSE_S)
            self._halted_s = max(self._halted_s, time.monotonic() - due_s)


def check_disk(state_directory: Path, recording: Recording | None) -> Iterator[Finding]:
    """Yield whether there is space where a daemon writes; without a configuration (None) nothing is recorded."""
    yield _space(_STATE, state_directory, _STATE_MB, "what waits for a broker is kept in memory alone")
    if recording is not None:
        yield _space(_RECORDINGS, recording.directory, float(recording.min_free_mb), "nothing is recorded")


def _space(check: Check, directory: Path, needed_mb: float, consequence: str) -> Finding:
    try:
        free_mb = _free_mb(directory)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        trouble = "the disk is full" if full else f"cannot be written ({meaning_of(error)})"
        remedy = "name another directory, or make this one writable"
        return check.fault(f"{directory}: {trouble}: {consequence}", remedy)
    figures = f"{directory}: {free_mb:.0f} MB are free, {needed_mb:g} MB are needed"
    amount = Amount(free_mb, needed_mb, "MB")
    if free_mb >= needed_mb:
        return check.ok(figures, amount)
    return check.fault(f"{figures}: {consequence}", "free space on it, or choose another disk", amount)


def _free_mb(directory: Path) -> float:
    """Return the space in a directory, or in the nearest one above that exists; OSError if it cannot be written."""
    place = directory
    while not place.exists() and place != place.parent:
        place = place.parent
    with tempfile.TemporaryFile(dir=place):  # permissions do not show a read-only file system
        system = os.statvfs(place)
    return system.f_bavail * system.f_frsize / _MB


def is_synchronised() -> bool | None:
    """Ask the kernel whether its clock is synchronised; None where it may not be asked."""
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.create_string_buffer(2 * _TIMEX_BYTES))
    except (OSError, AttributeError):
        return None
    return None if state < 0 else state != _TIME_ERROR


def check_clock(synchronised: Callable[[], bool | None] = is_synchronised) -> Iterator[Finding]:
    """Yield the finding on the computer's clock."""
    match synchronised():
        case None:
            yield _SYNCHRONISED.not_checked("the kernel does not report it")
        case True:
            yield _SYNCHRONISED.ok("the kernel's clock is kept by a time server")
        case False:
            yield _SYNCHRONISED.warning(
                "the clock is not synchronised: times do not agree with those of other computers"
            )
