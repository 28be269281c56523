"""Files of a continuous recording: their names, when the next begins, and the disk space they may take."""

import fcntl
import logging
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from resonator_daemon.base.errors import UserError, meaning_of
from resonator_daemon.base.host.files import make_directory
from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.recording.mcap_messages import read_records
from resonator_daemon.board.recording.reader import Origin, read_header
from resonator_daemon.board.recording.writer import RecordingWriter

_MS_NS: Final = 1_000_000
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_STAMP: Final = r"\d{8}T\d{6}\.\d{3}Z"
_AGAIN: Final = 1.1  # so much more room lets a recording go on that ended for want of it

LogLine = Callable[[int, str], None]


class NoRoomError(UserError):
    """The disk has less room than is to be kept free."""


@dataclass(frozen=True)
class Series:
    """Where the files of a recording go, and how large they get; what is None has no bound.

    Parameters
    ----------
    directory
        Is made where it is missing.
    name
        Each file's name begins with it; the time of the file's beginning follows.
    label
        Ends each file's name.
    file_max_bytes, file_max_ns
        Size and time after which the next file begins.
    max_total_bytes
        Of all recordings of this name in the directory; the oldest are removed.
    min_free_bytes
        With less room on the disk nothing is recorded.
    resumes
        A recording that the disk has ended goes on in a new file, as soon as it can.
    begins_late
        One that resumes begins, too, where the first file cannot be made yet.
    """

    directory: Path
    name: str
    label: str | None = None
    file_max_bytes: int | None = None
    file_max_ns: int | None = None
    max_total_bytes: int | None = None
    min_free_bytes: int = 0
    resumes: bool = False
    begins_late: bool = False

    def is_over(self, file: RecordingWriter, now_ns: int) -> bool:
        """Return whether the next file is to begin."""
        if not file.replayable:
            return False
        too_large = self.file_max_bytes is not None and file.size_bytes >= self.file_max_bytes
        return too_large or (self.file_max_ns is not None and now_ns - file.begun_ns >= self.file_max_ns)

    def make(self, origin: Origin, utc_ns: int) -> RecordingWriter:
        """Make the file that begins now.

        Raises
        ------
        UserError
            It cannot be made.
        """
        try:
            make_directory(self.directory)
            while os.path.lexists(path := self.path(utc_ns)):  # of a time before the host's clock was set back
                utc_ns += _MS_NS
        except OSError as error:
            raise UserError(f"{self.directory} cannot be made: {meaning_of(error)}") from error
        return RecordingWriter(path, origin, utc_ns)

    def files(self) -> list[Path]:
        """Return what has the name of a file of this name, oldest first."""
        pattern = re.compile(rf"{re.escape(self.name)}-({_STAMP})(-[A-Za-z0-9_-]+)?\.mcap")
        found = ((pattern.fullmatch(path.name), path) for path in self.directory.iterdir())
        return [path for _, path in sorted((match[1], path) for match, path in found if match)]

    def path(self, utc_ns: int) -> Path:
        """Return the file that begins then."""
        begun = _EPOCH + timedelta(milliseconds=utc_ns // _MS_NS)
        stamp = f"{begun:%Y%m%dT%H%M%S}.{begun.microsecond // 1000:03d}Z"
        return self.directory / ("-".join(filter(None, (self.name, stamp, self.label))) + ".mcap")


class DiskSpace:
    """Disk space that the recordings of one name take, and that is kept free.

    Parameters
    ----------
    log_line
        Receives lines for the log: what is removed, and what cannot be.

    Attributes
    ----------
    files_removed : int
        Since this was made.
    """

    def __init__(self, series: Series, log_line: LogLine) -> None:
        self._series = series
        self._log_line = log_line
        self._others_bytes: int | None = None  # None: not counted yet
        self._logged: set[Path] = set()
        self.files_removed = 0

    def check(self, *, again: bool) -> None:
        """Check what is left on the disk; where it was too little before, a tenth more is wanted.

        Raises
        ------
        NoRoomError
            It is too little.
        UserError
            The directory cannot be made.
        """
        directory, min_free_bytes = self._series.directory, self._series.min_free_bytes
        try:
            make_directory(directory)
            free_bytes = shutil.disk_usage(directory).free
        except OSError as error:
            raise UserError(f"{directory} cannot be used: {meaning_of(error)}") from error
        if free_bytes < min_free_bytes * (_AGAIN if again else 1.0):
            raise NoRoomError(
                f"{directory} has {free_bytes / 1e6:.0f} MB left, and {min_free_bytes / 1e6:.0f} MB are kept free "
                "(min_free_mb in [recording]); free space on that disk"
            )

    def begin(self) -> None:
        """Count again what is there; a new file has begun."""
        self._others_bytes = None

    def remove_oldest(self, own: RecordingWriter) -> None:
        """Remove the oldest files until all of them, with the one that is being written, fit the budget."""
        max_total_bytes = self._series.max_total_bytes
        if max_total_bytes is None:
            return
        if self._others_bytes is not None and self._others_bytes + own.size_bytes <= max_total_bytes:
            return
        others = dict(self._sizes(own.path))
        total_bytes = sum(others.values()) + own.size_bytes
        for path, size_bytes in others.items():
            if total_bytes <= max_total_bytes:
                break
            if self._remove(path):
                self.files_removed += 1
                self._log_line(logging.INFO, f"{path} was removed: recordings exceeded {max_total_bytes / 1e6:g} MB")
                total_bytes -= size_bytes
        self._others_bytes = total_bytes - own.size_bytes

    def _sizes(self, own: Path) -> Iterator[tuple[Path, int]]:
        for path in self._series.files():
            with suppress(OSError):  # removed meanwhile, or not readable
                info = path.lstat()
                if path != own and stat.S_ISREG(info.st_mode) and self._is_ours(path):
                    yield path, info.st_size

    def _remove(self, path: Path) -> bool:
        """Remove a recording that no process writes; return whether it is gone."""
        try:
            with path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                os.unlink(path)
        except BlockingIOError:
            return False  # it is being written
        except OSError as error:
            if path not in self._logged:
                self._logged.add(path)
                self._log_line(logging.WARNING, f"{path} cannot be removed: {meaning_of(error)}")
            return False
        return True

    def _is_ours(self, path: Path) -> bool:
        """Return whether the header of a file has this name."""
        with path.open("rb") as file:
            try:
                return read_header(str(path), read_records(file)).get("name") == self._series.name
            except LinkUnavailableError:
                return False
