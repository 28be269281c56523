"""The computer that is checked: its files below a root that a test may choose, what may be opened, how busy it is."""

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from resonator_daemon.base.host.load import BUSY_PERCENT, LoadMeter, busy_reason

_PULSE_S: Final = 0.005
_HALT_S: Final = 0.03  # a program that runs at once is late by a few ms; boards count as silent after some 50 ms


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


class Load:
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

    def busy(self) -> str:
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
