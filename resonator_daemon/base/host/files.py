"""Directories of a running daemon, and atomic creation of files: complete or absent, never over another.

Devices and pipes are no files in this sense: what is written to them is gone, and they stay. `replace_file` puts a new
version of a file in the place of the old one.
"""

import io
import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final

from resonator_daemon.base.errors import UserError, meaning_of

_OURS: Final = "resonatord"  # below the directories that belong to all programs
_OTHERS_WRITE: Final = stat.S_IWGRP | stat.S_IWOTH


def state_directory() -> Path:
    """Return the state directory, which outlives a run: systemd's, else the XDG Base Directory Specification's."""
    return _directory("STATE_DIRECTORY", "XDG_STATE_HOME", "~/.local/state")


def cache_directory() -> Path:
    """Return the cache directory, whose files can be rebuilt.

    It is systemd's, else the XDG Base Directory Specification's.
    """
    return _directory("CACHE_DIRECTORY", "XDG_CACHE_HOME", "~/.cache")


def _directory(systemd_variable: str, xdg_variable: str, default: str) -> Path:
    if given := os.environ.get(systemd_variable):
        return Path(given.split(":")[0])
    base = os.environ.get(xdg_variable, "")
    return Path(base if os.path.isabs(base) else os.path.expanduser(default)) / _OURS


def runtime_directory(instance: str) -> Path:
    """Return the runtime directory of the daemon whose configuration file is called `instance`.

    It is systemd's choice, else below the XDG Base Directory Specification's, else below the directory for temporary
    files; `make_private` makes it.
    """
    if given := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(given.split(":")[0])
    return _of_the_user() / (instance if instance not in (".", "..") else f"_{instance}")


def runtime_directories() -> tuple[Path, ...]:
    """Return the directories that contain runtime directories of daemons visible to this user."""
    system, own = Path("/run") / _OURS, Path(f"/run/user/{os.geteuid()}") / _OURS
    return tuple(dict.fromkeys((system, _of_the_user(), own, _temporary())))


def make_private(directory: Path) -> None:
    """Create a directory that only this user can write to, and its parent, if they are missing.

    Raises
    ------
    OSError
        It cannot be made, or one of both belongs to somebody else, who could take the files' places.
    """
    for place in (directory.parent, directory):
        place.mkdir(mode=0o700, exist_ok=True)
        found = place.lstat()
        if not stat.S_ISDIR(found.st_mode):
            raise NotADirectoryError(f"{place} is no directory; remove it")
        sticky = found.st_mode & stat.S_ISVTX and place != directory  # as /tmp: nobody takes what others have there
        if found.st_uid not in (0, os.geteuid()) or (found.st_mode & _OTHERS_WRITE and not sticky):
            raise PermissionError(
                f"{place} belongs to user {found.st_uid} and has mode {found.st_mode & 0o7777:o}, so that others could "
                "put a socket of theirs there; remove it"
            )


def _of_the_user() -> Path:
    base = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(base) / _OURS if os.path.isabs(base) else _temporary()


def _temporary() -> Path:
    return Path("/tmp") / f"{_OURS}-{os.geteuid()}"  # not $TMPDIR, which those who ask may not share


if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class NoNewFileError(UserError):
    """The name exists already, or nothing can be created there."""

    code = "output"


class NewFile:
    """File that is `NAME.part` until it is complete; character devices and pipes are written directly.

    Parameters
    ----------
    path
        Its name once it is whole.

    Raises
    ------
    NoNewFileError
        It is being written already, or cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._flows = takes_a_stream(path)
        self._part = path if self._flows else path.with_name(path.name + ".part")
        try:
            self.file: IO[bytes] = io.BufferedWriter(_Stream(path, "w")) if self._flows else self._part.open("xb")
        except FileExistsError as error:
            why = f"{self._part} exists: another process writes it, or was killed; remove it if it was killed"
            raise NoNewFileError(why) from error
        except OSError as error:
            raise NoNewFileError(f"{path} cannot be written: {meaning_of(error)}") from error

    def keep(self) -> int:
        """Flush to the disk, rename, and return the size in bytes.

        Raises
        ------
        NoNewFileError
            Another has the name by now.
        """
        self.file.flush()
        if self._flows:
            size_bytes = self.file.tell()
            self.file.close()
            return size_bytes
        os.fsync(self.file.fileno())
        self.file.close()
        size_bytes = self._part.stat().st_size
        check_new(self.path)
        os.rename(self._part, self.path)
        self._part = self.path
        sync_directory(self.path.parent)
        return size_bytes

    def discard(self) -> None:
        """Remove the file, under either name."""
        with suppress(OSError):  # closing tries once more to write unflushed output
            self.file.close()
        if not self._flows:
            self._part.unlink(missing_ok=True)


class _Stream(io.FileIO):
    """Raw stream that counts its bytes; devices and pipes have no position."""

    _written_bytes = 0

    def write(self, data: "ReadableBuffer") -> int:
        written_bytes = super().write(data)
        self._written_bytes += written_bytes or 0  # None: a full pipe
        return written_bytes

    def tell(self) -> int:
        return self._written_bytes

    def seekable(self) -> bool:
        return False


def takes_a_stream(path: Path) -> bool:
    """Return whether the path is a character device or a pipe, as /dev/null or /dev/stdout."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)


def check_new(path: Path) -> None:
    """Check that the name is free, or that it is a stream.

    Raises
    ------
    NoNewFileError
        Something has it.
    """
    if path.is_dir():
        raise NoNewFileError(f"{path} is a directory, name a file in it")
    if os.path.lexists(path) and not takes_a_stream(path):
        raise NoNewFileError(f"{path} exists already, and nothing is overwritten; choose another file")


def replace_file(path: Path, content: bytes, mode: int | None = None) -> None:
    """Write a file, with this mode if one is given; the old one stays until the new one is on the disk.

    Raises
    ------
    OSError
        It cannot be written; the old one is as before.
    """
    make_directory(path.parent)
    fresh = path.with_name(f".{path.name}.new")  # left behind only if the process is killed
    try:
        with fresh.open("wb") as stream:
            if mode is not None:
                os.fchmod(stream.fileno(), mode)
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        fresh.replace(path)
    except OSError:
        fresh.unlink(missing_ok=True)
        raise
    sync_directory(path.parent)


def make_directory(path: Path, mode: int = 0o777) -> None:
    """Make a directory with this mode, and its parents, where they are missing; a power failure does not remove them.

    Raises
    ------
    OSError
        It cannot be made.
    """
    missing = [place for place in (path, *path.parents) if not place.exists()]
    path.mkdir(mode=mode, parents=True, exist_ok=True)
    for place in missing:
        with suppress(PermissionError):  # a parent of others that this user cannot list
            sync_directory(place.parent)


def sync_directory(path: Path) -> None:
    """Wait until the disk has the names in a directory: those that are new, and the removal of others.

    Raises
    ------
    OSError
        The disk failed, or the directory is gone.
    """
    directory = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)
