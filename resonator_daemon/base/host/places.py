"""Directories of a running daemon."""

import os
import stat
from pathlib import Path
from typing import Final

_OURS: Final = "resonatord"  # below the directories that belong to all programs
_OTHERS_WRITE: Final = stat.S_IWGRP | stat.S_IWOTH


def state_directory() -> Path:
    """Return the state directory, which outlives a run: systemd's, else the XDG Base Directory Specification's."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    base = os.environ.get("XDG_STATE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path(os.path.expanduser("~/.local/state"))) / "resonatord"


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
