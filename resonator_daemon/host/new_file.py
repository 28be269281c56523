"""Files that are there in whole or not at all, and never in the place of another; also where a verb is interrupted."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO, Final

from resonator_daemon.errors import InterruptedVerbError, OperatorError

_Handler = Callable[[int, FrameType | None], object] | int | None

_ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class NoNewFileError(OperatorError):
    """There is something of that name already, or nothing can be made there."""

    code = "output"


class NewFile:
    """A file under another name until it is whole: `NAME.part`.

    Parameters
    ----------
    path
        Its name once it is whole.

    Raises
    ------
    NoNewFileError
        It is being written already, or cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._part = part_of(path)
        try:
            self.file: IO[bytes] = self._part.open("xb")
        except FileExistsError as error:
            raise part_is_there(self._part) from error
        except OSError as error:
            raise NoNewFileError(f"{path} cannot be written: {error.strerror}") from error

    def keep(self) -> int:
        """Have it on the disk and give it its name; returns its size in bytes.

        Raises
        ------
        NoNewFileError
            Another has the name by now.
        """
        self.file.flush()
        os.fsync(self.file.fileno())
        self.file.close()
        size_bytes = self._part.stat().st_size
        check_new(self.path)
        os.rename(self._part, self.path)
        self._part = self.path
        return size_bytes

    def discard(self) -> None:
        """Remove what there is of it, under either name."""
        with suppress(OSError):  # it tries once more to write what it could not
            self.file.close()
        self._part.unlink(missing_ok=True)


def part_of(path: Path) -> Path:
    """Return the name of a file or directory that is not whole yet."""
    return path.with_name(path.name + ".part")


def part_is_there(part: Path) -> NoNewFileError:
    """Return the error that says that a name for what is not whole yet is taken."""
    return NoNewFileError(f"{part} is there: it is being written, or what wrote it was killed; remove it in that case")


def check_new(path: Path) -> None:
    """Check that nothing has that name.

    Raises
    ------
    NoNewFileError
        Something has it.
    """
    if path.is_dir():
        raise NoNewFileError(f"{path} is a directory, name a file in it")
    if os.path.lexists(path):
        raise NoNewFileError(f"{path} is there already, and nothing is overwritten; name another file")


@contextmanager
def interruptible(unfinished: str) -> Iterator[None]:
    """Have Ctrl-C, SIGTERM and SIGHUP end what is done here alike: cleaned up as after any error, and said.

    Each raises KeyboardInterrupt, the first of them only, so that cleaning up comes to its end. What the process
    ignores, as SIGHUP under nohup, it goes on ignoring.

    Parameters
    ----------
    unfinished
        What becomes of what is not whole, as "nothing is written".

    Raises
    ------
    InterruptedVerbError
        One of them came.
    """
    before: dict[int, _Handler] = {}

    def end(_number: int, _frame: FrameType | None) -> None:
        for number in before:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    try:
        if threading.current_thread() is threading.main_thread():  # no other can have handlers
            for number in _ENDING:
                if (handler := signal.getsignal(number)) is not signal.SIG_IGN:
                    before[number] = handler
                    signal.signal(number, end)
        yield
    except KeyboardInterrupt as error:
        raise InterruptedVerbError(f"interrupted: {unfinished}") from error
    finally:
        for caught, handler in before.items():
            signal.signal(caught, handler)
