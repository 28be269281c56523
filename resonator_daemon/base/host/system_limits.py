"""Errors of the operating system in plain words, and the limit of open files."""

import errno
import os
import re
import resource
from typing import Final

from resonator_daemon.base.errors import UserError

OPEN_FILES_MIN: Final = 64
_TOO_MANY: Final = (errno.EMFILE, errno.ENFILE)
_OF_ASYNCIO: Final = "Connect call failed"
_NUMBER: Final = re.compile(r"\[Errno (\d+)\]")


class TooFewFilesError(UserError):
    """Limit of open files too low for any command."""

    code = "open_files"


def check_open_files() -> None:
    """Raise TooFewFilesError where this process may open too few files."""
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= most < OPEN_FILES_MIN:
        raise TooFewFilesError(
            f"this process may have {most} files open, and needs {OPEN_FILES_MIN}; raise the limit "
            "(ulimit -n 1024, LimitNOFILE= of a systemd unit)"
        )


def reason_of(error: OSError) -> str:
    """Return what an error means, without its number, and the name of the file if it has one."""
    words = meaning_of(error)
    return words if error.filename is None or error.errno in _TOO_MANY else f"{error.filename}: {words}"


def meaning_of(error: Exception) -> str:
    """Return what an error means, without its number and the name of the file.

    asyncio puts addresses in place of the meaning, and joins the errors of all addresses of a host to one.
    """
    number = getattr(error, "errno", None)
    words = str(getattr(error, "strerror", None) or error)
    if isinstance(error, TimeoutError) and words in ("", "timed out"):
        return "no answer in time"
    if numbers := [int(found) for found in _NUMBER.findall(words)]:
        return "; ".join(dict.fromkeys(map(os.strerror, numbers)))
    if number in _TOO_MANY:  # whichever file it was
        return f"{os.strerror(number)}; raise the limit (ulimit -n)"
    if number is not None and words.startswith(_OF_ASYNCIO):
        return os.strerror(number)
    return words or type(error).__name__
