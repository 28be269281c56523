"""Errors that end a command, with exit code and JSON object; classes by who can resolve them.

A programmer's mistake is a ValueError and noise on the wire a counted value: neither is here.
"""

import errno
import os
import re
import resource
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, ClassVar, Final


class ExitCode(IntEnum):
    """Exit codes of all commands; the systemd unit does not restart on UNAVAILABLE or CONFIG."""

    DONE = 0
    FAILED = 1
    USAGE = 2
    UNAVAILABLE = 69  # EX_UNAVAILABLE of sysexits.h: no such link, board or broker, or none that can be used
    CONFIG = 78  # EX_CONFIG of sysexits.h


FAILURES: Final = {
    "usage": "wrong arguments, or arguments that contradict each other",
    "config": "errors in a configuration or plate file, or no such file",
    "interrupted": "ended by Ctrl-C or SIGTERM before its end; the object has the partial result",
    "system": "an error of the operating system, such as a full disk",
    "open_files": "this process may open fewer than 64 files",
    "missing_library": "an optional library is not installed",
    "output": "the output exists already, or cannot be created or written",
    "install": "a file cannot be placed or removed, or a step failed",
    "no_recording": "the file does not exist, or is not a recording that can be used here",
    "no_column": "in Python: the table does not have this column",
    "no_mark": "the recording does not have this mark",
    "no_span": "the span ends before it begins",
    "differs": "a recording is damaged, or its replay differs from what is recorded",
    "not_repaired": "nothing of the recording can be kept, or no copy can be made",
    "ended": "the recording ended early",
    "no_board": "the link cannot be opened, no board answers, or none sends frames",
    "port_in_use": "another program holds the port, device or connection",
    "refused": "the board can never serve this plate; or, in Python, the daemon refused without a code of its own",
    "listen": "the address to listen on is in use, or this computer does not have it",
    "dds": "the DDS domain cannot be joined",
    "no_broker": "no broker answers at the address",
    "no_scheduler": "no Dask scheduler answers at the address, or it has ended",
    "workers_died": "workers of a Dask cluster died repeatedly",
    "no_daemon": "no such daemon runs",
    "no_answer": "the daemon does not answer",
    "denied": "the access rules of the broker, or of this computer, do not allow it",
    "name_taken": "another process publishes under this name",
    "already_running": "another daemon runs with the same configuration file",
    "cannot_share": "the broker does not share messages among several decoders",
    "not_calibrated": "the calibration has no result; the plate file is as before",
    "no_plan": "the codes cannot be planned as wanted; no plate file was written",
    "fault": "the doctor found a fault: `cause` and `findings`",
    "lost": "touches were missed, or frames or messages lost",
}
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


class SystemFailureError(UserError):
    """Error of the operating system, such as a standard output on a full disk."""

    exit_code = ExitCode.FAILED
    code = "system"


class DifferenceError(UserError):
    """Recording that is damaged, or whose replay differs from what is recorded."""

    exit_code = ExitCode.FAILED
    code = "differs"


class LossError(UserError):
    """Touches that were missed, or frames or messages that were lost."""

    exit_code = ExitCode.FAILED
    code = "lost"


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
