"""Waits for the file of a port, by inotify: a device is opened as soon as it is plugged in."""

import logging
import os
import select
import threading
import time

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.board.links.inotify import DirectoryEvent, DirectoryEvents

log = logging.getLogger(__name__)

_MAX_LINKS = 40  # as Linux follows
_TRIES = 5  # to watch directories that come and go

_Places = frozenset[tuple[str, str | None]]  # directories and the name awaited there; None: any


class PortWatch:
    """Watches the place where a port appears.

    What happens between two calls of `wait` is not missed: the second returns at once.
    `wake` may be called from any thread; everything else belongs to one.

    Parameters
    ----------
    path
        The file of the port, or a directory in whose tree it appears; None: time alone ends a wait.
    """

    def __init__(self, path: str | None) -> None:
        self._path = path
        self._places: _Places = frozenset()
        self._events: DirectoryEvents | None = None
        self._closed = False
        self._lock = threading.Lock()  # so that nobody wakes a descriptor that has become somebody else's
        self._awake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._ready = select.poll()
        self._ready.register(self._awake, select.POLLIN)
        if path is not None:
            try:
                self._events = DirectoryEvents()
            except OSError as error:
                log.info("ports are looked for from time to time, not watched: no inotify (%s)", meaning_of(error))
            else:
                self._ready.register(self._events, select.POLLIN)
                self._aim(self._events, path)

    def wait(self, timeout_s: float) -> bool:
        """Wait; return True as soon as the port may have come or may be permitted now, False after time or `wake`."""
        deadline = time.monotonic() + timeout_s
        while True:
            ready = {descriptor for descriptor, _ in self._ready.poll(max(0.0, deadline - time.monotonic()) * 1e3)}
            if self._awake in ready:
                os.eventfd_read(self._awake)
                return False
            if self._events is not None and self._path is not None and self._events.fileno() in ready:
                before = self._places
                happened = self._events.read()
                self._aim(self._events, self._path)
                if any(_concerns(event, before, self._path) for event in happened):
                    return True
            if time.monotonic() >= deadline:
                return False

    def wake(self) -> None:
        """End the present or, if there is none, the next `wait`."""
        with self._lock:
            if not self._closed:
                os.eventfd_write(self._awake, 1)

    def close(self) -> None:
        with self._lock:
            if self._closed:
                return
            self._closed = True
            os.close(self._awake)
        if self._events is not None:
            self._events.close()

    def _aim(self, events: DirectoryEvents, path: str) -> None:
        """Watch the places that matter now; what changed while they were being watched is looked at again."""
        for _ in range(_TRIES):
            self._places = _places(path)
            events.watch({directory for directory, _ in self._places})
            if _places(path) == self._places:
                return


def _concerns(event: DirectoryEvent, places: _Places, path: str) -> bool:
    """Return whether an event at these places may have brought the port."""
    if (event.directory, None) in places:
        return True
    names = [name for directory, name in places if directory == event.directory and name is not None]
    if not event.name or event.name in names:
        return os.path.exists(path)
    # The same device may come back as ttyACM1.
    return any(_numbered(name) == _numbered(event.name) is not None for name in names)


def _places(path: str) -> _Places:
    if os.path.isdir(path):
        return frozenset((directory, None) for directory, _, _ in os.walk(path))
    return _places_of_path(path)


def _places_of_path(path: str) -> _Places:
    """Return the nearest directory that exists on the way to `path`, and so on for each symbolic link it leads to."""
    places = set()
    current = os.path.abspath(path)
    for _ in range(_MAX_LINKS):
        directory, name = os.path.split(current)
        while not os.path.isdir(directory):
            directory, name = os.path.split(directory)
        directory = os.path.realpath(directory)
        places.add((directory, name))
        try:
            current = os.path.join(directory, os.readlink(os.path.join(directory, name)))
        except OSError:  # it is none, or is not there
            break
    return frozenset(places)


def _numbered(name: str) -> str | None:
    """Return what stands before a number at the end; None where there is no such pair."""
    stem = name.rstrip("0123456789")
    return stem if stem and stem != name else None
