"""Room on the disk for what the daemon keeps: events that wait for a broker, and recordings."""

import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from resonator_daemon.config import Recording
from resonator_daemon.doctor.finding import Amount, Area, Check, Finding
from resonator_daemon.recording.file_series import Series

STATE: Final = Check("disk.state", Area.SOFTWARE, "room for state")
RECORDINGS: Final = Check("disk.recordings", Area.SOFTWARE, "room for recordings")
BUDGET: Final = Check("disk.budget", Area.SOFTWARE, "budget of recordings")

_STATE_MB: Final = 50.0
_MB: Final = 1e6


class _Room(NamedTuple):
    free_mb: float
    trouble: str  # why nothing can be written, empty where it can


def check_disk(state_directory: Path, recording: Recording | None, name: str | None) -> Iterator[Finding]:
    """Yield whether there is room where a daemon writes.

    Parameters
    ----------
    state_directory
        Of the daemon.
    recording
        None: without a configuration nothing is recorded.
    name
        Of the daemon, which its recordings have; None where only the board has it: then none of them are known.
    """
    yield _judge(STATE, state_directory, _STATE_MB, "what waits for a broker is kept in memory alone")
    if recording is None:
        return
    yield _judge(RECORDINGS, recording.directory, float(recording.min_free_mb), "nothing is recorded")
    yield _budget(recording, name)


def _judge(check: Check, directory: Path, needed_mb: float, consequence: str) -> Finding:
    room = _room(directory)
    if room.trouble:
        return check.fault(
            f"{directory}: {room.trouble}: {consequence}", "name another directory, or make this one writable"
        )
    figures = f"{directory}: {room.free_mb:.0f} MB are free, {needed_mb:g} MB are needed"
    if room.free_mb >= needed_mb:
        return check.ok(figures, Amount(room.free_mb, needed_mb, "MB"))
    return check.fault(
        f"{figures}: {consequence}", "make room, or name another disk", Amount(room.free_mb, needed_mb, "MB")
    )


def _budget(recording: Recording, name: str | None) -> Finding:
    room = _room(recording.directory)
    if room.trouble:
        return BUDGET.not_checked("the directory cannot be written")
    taken_mb = _taken_mb(recording.directory, name) if name is not None else 0.0
    attainable_mb = room.free_mb + taken_mb - recording.min_free_mb
    evidence = (
        f"recordings may take {recording.max_total_mb:g} MB; with the {taken_mb:.0f} MB they take now, the disk has "
        f"{max(attainable_mb, 0.0):.0f} MB for them"
    )
    if attainable_mb >= recording.max_total_mb:
        return BUDGET.ok(evidence, Amount(float(recording.max_total_mb), attainable_mb, "MB"))
    return BUDGET.warning(
        f"{evidence}: it is full before the oldest recordings give way",
        "lower recording.max_total_mb, or name a larger disk",
        Amount(float(recording.max_total_mb), attainable_mb, "MB"),
    )


def _room(directory: Path) -> _Room:
    """Return the room in a directory, or in the nearest one above that exists: it is made when it is needed."""
    place = directory
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        return _Room(0.0, f"{place} is a file")
    try:
        with tempfile.TemporaryFile(dir=place):  # permissions do not show a read-only file system
            pass
        system = os.statvfs(place)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        return _Room(0.0, f"cannot be written ({error.strerror})" if not full else "the disk is full")
    return _Room(system.f_bavail * system.f_frsize / _MB, "")


def _taken_mb(directory: Path, name: str) -> float:
    """Return what a daemon's own recordings take: others do not give way to it."""
    sizes = []
    for file in Series(directory, name).files() if directory.is_dir() else ():
        try:
            sizes.append(file.stat().st_size)
        except OSError:
            continue  # it gave way meanwhile
    return sum(sizes) / _MB
