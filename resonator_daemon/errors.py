"""Errors that end a command, with exit code and JSON object; classes by who can resolve them.

A programmer's mistake is a ValueError and noise on the wire a counted value: neither is here.
"""

from collections.abc import Mapping
from enum import IntEnum
from typing import Any, ClassVar


class ExitCode(IntEnum):
    """Exit codes of all commands; the systemd unit does not restart on UNAVAILABLE or CONFIG."""

    DONE = 0
    FAILED = 1
    USAGE = 2
    UNAVAILABLE = 69  # EX_UNAVAILABLE of sysexits.h: no such link, board or broker, or none that can be used
    CONFIG = 78  # EX_CONFIG of sysexits.h


class UserError(Exception):
    """Error that the user can resolve; each message is one line with quantity, value, limit and remedy.

    Attributes
    ----------
    code, hint
        Of the JSON error: a stable identifier, and where to read more.
    so_far
        Keys of the JSON object next to the error.
    """

    exit_code = ExitCode.CONFIG
    code: str = "config"
    hint: ClassVar[str] = ""

    def __init__(self, *messages: str) -> None:
        super().__init__("\n".join(messages))
        self.messages = messages
        self.so_far: Mapping[str, Any] = {}


class InterruptedCommandError(UserError):
    """Command that was interrupted before its end; `so_far` holds its partial result."""

    exit_code = ExitCode.FAILED
    code = "interrupted"

    def __init__(self, message: str, so_far: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.so_far = so_far or {}


class UsageError(UserError):
    """Arguments that contradict each other or what they name; one message for each finding."""

    exit_code = ExitCode.USAGE
    code = "usage"


class NoRecordingError(UsageError):
    """File named by the arguments that is no recording, or none that can be replayed with the configuration."""

    code = "no_recording"


class ConfigurationError(UserError):
    """Invalid configuration or plate file; one message for each finding."""


class IncompatibleBoardError(UserError):
    """Board on the link that can never serve this configuration."""

    exit_code = ExitCode.UNAVAILABLE
    code = "refused"
