"""What `import resonatord` offers: recordings as tables, messages as they come, commands.

Errors are one sentence each, without the frames that they passed.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from resonator_daemon.base.errors import ExitCode, UserError
from resonator_daemon.board.links.link import LinkUnavailableError

# Options of the command line that messages name, as arguments of the package's functions.
_ARGUMENTS: Final = {"--config FILE": "config=FILE", "--url": "url", "--from": "start", "--until": "until"}


class RecordingError(UserError):
    """The file is no recording that can be read."""

    exit_code = ExitCode.UNAVAILABLE
    code = "no_recording"


class RecordingWarning(UserWarning):
    """Only a part of a recording could be read, or it gives other messages than it did live."""


@contextmanager
def readable_errors() -> Iterator[None]:
    """Raise errors that a user can resolve without their causes, in terms of the package's arguments."""
    try:
        yield
    except LinkUnavailableError as error:
        raise RecordingError(_in_terms_of_arguments(str(error))) from None
    except UserError as error:
        error.messages = tuple(map(_in_terms_of_arguments, error.messages))
        error.args = ("\n".join(error.messages),)
        raise error.with_traceback(None) from None


def _in_terms_of_arguments(message: str) -> str:
    for option, argument in _ARGUMENTS.items():
        message = message.replace(option, argument)
    return message
