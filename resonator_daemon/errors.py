"""Who must act on a failure, and the exit code that says so.

A programmer's mistake is a ValueError; noise on the wire is a counted value; neither is here.
"""

from enum import IntEnum


class ExitCode(IntEnum):
    """What a verb returns to the shell; the systemd unit does not restart on UNAVAILABLE or CONFIG."""

    DONE = 0
    FAILED = 1
    USAGE = 2
    UNAVAILABLE = 69  # EX_UNAVAILABLE of sysexits.h: link or broker cannot ever work
    CONFIG = 78  # EX_CONFIG of sysexits.h


class OperatorError(Exception):
    """Something the operator must mend; each message is one line with quantity, value, limit and remedy."""

    exit_code = ExitCode.CONFIG

    def __init__(self, *messages: str) -> None:
        super().__init__("\n".join(messages))
        self.messages = messages


class ConfigError(OperatorError):
    """The configuration or the plate file cannot be used; carries every finding at once."""


class IncompatibleBoardError(OperatorError):
    """The board on the link can never serve this configuration."""

    exit_code = ExitCode.UNAVAILABLE
