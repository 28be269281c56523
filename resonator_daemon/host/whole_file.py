"""Replacement of files as a whole."""

import os
from pathlib import Path


def fresh_name(path: Path) -> Path:
    """Return the name of a file's next version while it is written; left behind only if the process is killed."""
    return path.with_name(f".{path.name}.new")


def replace_file(path: Path, content: bytes, mode: int | None = None) -> None:
    """Write a file, with this mode if one is given; the old one stays until the new one is on the disk.

    Raises
    ------
    OSError
        It cannot be written; the old one is as before.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = fresh_name(path)
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
    directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)
