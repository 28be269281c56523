"""Waits for the file of a port: a device is opened as soon as it is plugged in, or permitted."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from glob import escape, glob
from typing import Final

_LOOK_S: Final = 0.1

_Files = frozenset[tuple[str, int, int]]  # with inode and time of the last change, of permissions among others


class PortWatch:
    """Looks ten times a second at the place where a port appears.

    What happens between two calls of `wait` is not missed: the second returns at once.
    `wake` may be called from any thread; everything else belongs to one.

    Parameters
    ----------
    path
        The file of the port, or a directory in whose tree it appears; None: time alone ends a wait.
    """

    def __init__(self, path: str | None) -> None:
        self._path = path
        self._files = self._present()
        self._woken = threading.Event()

    def wait(self, timeout_s: float) -> bool:
        """Wait; return True as soon as the port may have come or may be permitted now, False after time or `wake`."""
        deadline = time.monotonic() + timeout_s
        left_s = timeout_s
        while not self._woken.wait(left_s if self._path is None else min(left_s, _LOOK_S)):
            before, self._files = self._files, self._present()
            if self._files - before:
                return True
            if (left_s := deadline - time.monotonic()) <= 0.0:
                return False
        self._woken.clear()
        return False

    def wake(self) -> None:
        """End the present or, if there is none, the next `wait`."""
        self._woken.set()

    def _present(self) -> _Files:
        if self._path is None:
            return frozenset()
        found = []
        for file in _tree(self._path) if os.path.isdir(self._path) else _alike(self._path):
            with suppress(OSError):  # gone meanwhile
                status = os.stat(file)
                found.append((file, status.st_ino, status.st_ctime_ns))
        return frozenset(found)


def _tree(directory: str) -> Iterator[str]:
    for place, _, files in os.walk(directory):
        yield from (os.path.join(place, name) for name in files)


def _alike(path: str) -> Iterator[str]:
    """Yield a path, and what differs from it by a number: the same device may come back as ttyACM1."""
    yield path
    for place in {path, os.path.realpath(path)}:
        if (stem := place.rstrip("0123456789")) not in (place, f"{os.path.dirname(place)}/"):
            yield from (other for other in glob(f"{escape(stem)}[0-9]*") if other[len(stem) :].isdigit())
