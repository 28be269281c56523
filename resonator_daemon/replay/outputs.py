"""Where the messages of a replay go: lines of a file, or nowhere."""

import contextlib
import sys
from pathlib import Path
from typing import Any, Literal, Self, TextIO

import numpy as np

from resonator_daemon.errors import ExitCode, UserError
from resonator_daemon.host.new_file import NoNewFileError, check_new, takes_a_stream
from resonator_daemon.host.system_limits import meaning_of
from resonator_daemon.publishing.codec import Encoded
from resonator_daemon.publishing.payloads import Message
from resonator_daemon.replay.recorded_pipeline import Published


class OutputFailedError(UserError):
    """What the messages go to takes no more."""

    exit_code = ExitCode.FAILED
    code = "output"


class Lines:
    """One line of JSON for each message, in a new file, on stdout, or to a character device or a pipe.

    A new file without any message is removed again.

    Raises
    ------
    NoNewFileError
        The file is there already, or cannot be made.
    OutputFailedError
        It takes no more.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._closing = contextlib.ExitStack()
        self._file: TextIO = sys.stdout
        self._removable = False  # a new file without a message, which would stand in the way of the next try

    async def __aenter__(self) -> Self:
        if str(self._path) != "-":
            check_new(self._path)
            is_stream = takes_a_stream(self._path)
            mode: Literal["w", "x"] = "w" if is_stream else "x"
            try:
                self._file = self._closing.enter_context(self._path.open(mode, encoding="utf-8"))
                self._removable = not is_stream
            except OSError as error:
                raise NoNewFileError(f"{self._path} cannot be made: {meaning_of(error)}") from error
        return self

    async def __aexit__(self, _kind: object, error: BaseException | None, _where: object) -> None:
        try:
            self._closing.close()
            if self._removable:
                self._path.unlink(missing_ok=True)
        except OSError as failure:
            if error is None:
                raise self._failed(failure) from failure

    async def put(self, published: Published) -> None:
        self._removable = False
        try:
            self._file.write(line(published) + "\n")
        except OSError as error:
            if self._file is sys.stdout and isinstance(error, BrokenPipeError):
                raise  # the reader has what it wants, as `head`
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> OutputFailedError:
        return OutputFailedError(f"{self._path}: {meaning_of(error)}; what was written stays")


def payload_json(message: Message | Encoded) -> str:
    """Return what is published as JSON; for a message with arrays, the same keys with rows of numbers."""
    if isinstance(message, Encoded):
        return message.payload.decode()
    return message.model_dump_json(fallback=_rows)


def line(published: Published) -> str:
    """Return topic and payload as one JSON object."""
    return f'{{"topic":"{published.topic.path}","payload":{payload_json(published.message)}}}'


def _rows(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is nothing that messages have")
