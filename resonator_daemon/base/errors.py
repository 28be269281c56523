"""Errors that end a command, with exit code and JSON object; classes by who can resolve them.

A programmer's mistake is a ValueError and noise on the wire a counted value: neither is here.
"""

import errno
import json
import os
import re
import resource
from collections.abc import Mapping
from enum import IntEnum
from pathlib import Path
from typing import Any, ClassVar, Final


class ExitCode(IntEnum):
    """Exit codes of all commands; the systemd unit does not restart on UNAVAILABLE or CONFIG."""

    DONE = 0
    FAILED = 1
    USAGE = 2
    UNAVAILABLE = 69  # EX_UNAVAILABLE of sysexits.h: no such link, board or broker, or none that can be used
    CONFIG = 78  # EX_CONFIG of sysexits.h


FAILURES: Final[dict[str, str]] = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
"""Meaning of each `code` of an error."""


class UserError(Exception):
    """Error that the user can resolve; each message is one line with quantity, value, limit and remedy.

    Parameters
    ----------
    messages
        A line each.
    partial_result
        Partial result of the command: keys of the JSON object next to the error.
    code, exit_code
        Instead of those of the class.

    Attributes
    ----------
    code, hint
        Of the JSON error: one of `FAILURES`, or of a daemon's refusals; and where to read more.
    """

    exit_code = ExitCode.CONFIG
    code: str = "config"
    hint: ClassVar[str] = ""

    def __init__(
        self,
        *messages: str,
        partial_result: Mapping[str, Any] | None = None,
        code: str | None = None,
        exit_code: ExitCode | None = None,
    ) -> None:
        super().__init__("\n".join(messages))
        self.messages = messages
        self.code = code or self.code
        self.exit_code = exit_code or self.exit_code
        self.partial_result: Mapping[str, Any] = partial_result or {}


class InterruptedCommandError(UserError):
    """Command that was interrupted before its end; `partial_result` holds its partial result."""

    exit_code = ExitCode.FAILED
    code = "interrupted"


class DifferenceError(UserError):
    """Recording that is damaged, or whose replay differs from what is recorded."""

    exit_code = ExitCode.FAILED
    code = "differs"


class UsageError(UserError):
    """Arguments that contradict each other or what they name; one message for each finding."""

    exit_code = ExitCode.USAGE
    code = "usage"


class NoRecordingError(UsageError):
    """File named by the arguments that is no recording, or none that can be replayed with the configuration."""

    code = "no_recording"


class ConfigurationError(UserError):
    """Invalid configuration or plate file; one message for each finding."""


class MissingLibraryError(UserError):
    """Optional library that is needed only here, and is not installed."""

    code = "missing_library"


class ListenError(UserError):
    """Address to listen on that another process uses, or that this computer does not have."""

    exit_code = ExitCode.FAILED  # it may be free later: systemd starts a service again
    code = "listen"


class IncompatibleBoardError(UserError):
    """Board on the link that can never serve this configuration."""

    exit_code = ExitCode.UNAVAILABLE
    code = "refused"


OPEN_FILES_MIN: Final = 64
_TOO_MANY: Final = (errno.EMFILE, errno.ENFILE)
_OF_ASYNCIO: Final = "Connect call failed"
_NUMBER: Final = re.compile(r"\[Errno (\d+)\]")


def check_open_files() -> None:
    """Raise UserError where this process may open too few files for any command."""
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= most < OPEN_FILES_MIN:
        remedy = "raise the limit (ulimit -n 1024, LimitNOFILE= of a systemd unit)"
        text = f"this process may have {most} files open, and needs {OPEN_FILES_MIN}; {remedy}"
        raise UserError(text, code="open_files")


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
