"""Who must act on a failure, the exit code that says so, and the object that tells programs.

A programmer's mistake is a ValueError; noise on the wire is a counted value; neither is here.
"""

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import IntEnum
from typing import Any, ClassVar


class ExitCode(IntEnum):
    """What a verb returns to the shell; the systemd unit does not restart on UNAVAILABLE or CONFIG."""

    DONE = 0
    FAILED = 1
    USAGE = 2
    UNAVAILABLE = 69  # EX_UNAVAILABLE of sysexits.h: link or broker cannot ever work
    CONFIG = 78  # EX_CONFIG of sysexits.h


class OperatorError(Exception):
    """Something the operator must mend; each message is one line with quantity, value, limit and remedy.

    Attributes
    ----------
    code, hint
        For programs: a word that stays, and where to read more.
    so_far
        Keys of the object for programs beside the failure.
    """

    exit_code = ExitCode.CONFIG
    code: ClassVar[str] = "config"
    hint: ClassVar[str] = ""

    def __init__(self, *messages: str) -> None:
        super().__init__("\n".join(messages))
        self.messages = messages
        self.so_far: Mapping[str, Any] = {}


class InterruptedVerbError(OperatorError):
    """Somebody ended a verb before it came to its end; `so_far` is what it had by then."""

    exit_code = ExitCode.FAILED
    code = "interrupted"

    def __init__(self, message: str, so_far: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.so_far = so_far or {}


class ConfigError(OperatorError):
    """The configuration or the plate file cannot be used; carries every finding at once."""


class IncompatibleBoardError(OperatorError):
    """The board on the link can never serve this configuration."""

    exit_code = ExitCode.UNAVAILABLE
    code = "refused"


@contextmanager
def failure_told(verb: str, *, as_json: bool) -> Iterator[None]:
    """Have a failure of a verb printed as one object on stdout, too, where objects are asked for."""
    try:
        yield
    except OperatorError as error:
        if as_json:
            failure = {"code": error.code, "message": str(error), "hint": error.hint}
            told = {"verb": verb, "ok": False, "error": failure}
            sys.stdout.write(json.dumps({**error.so_far, **told}) + "\n")
        raise
