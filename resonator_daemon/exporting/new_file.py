"""A file that is there in whole or not at all, and never in the place of another."""

import os
from contextlib import suppress
from pathlib import Path
from typing import IO

from resonator_daemon.errors import ExitCode, OperatorError


class ExportFailedError(OperatorError):
    """What is read could not be written."""

    exit_code = ExitCode.FAILED


class NewFile:
    """A file under another name until it is whole: `NAME.part`.

    Parameters
    ----------
    path
        Its name once it is whole.

    Raises
    ------
    OperatorError
        It is being written already, or cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._part = path.with_name(path.name + ".part")
        try:
            self.file: IO[bytes] = self._part.open("xb")
        except FileExistsError as error:
            raise OperatorError(
                f"{self._part} is there: another export is writing it, or was killed; remove it in that case"
            ) from error
        except OSError as error:
            raise OperatorError(f"{path} cannot be written: {error.strerror}") from error

    def keep(self) -> int:
        """Close it and give it its name; returns its size in bytes. OperatorError where another has the name by now."""
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


def check_new(path: Path) -> None:
    """Check that nothing has that name; OperatorError says so where something has."""
    if path.is_dir():
        raise OperatorError(f"{path} is a directory, name a file in it")
    if os.path.lexists(path):
        raise OperatorError(f"{path} is there already, and nothing is overwritten; name another file")
