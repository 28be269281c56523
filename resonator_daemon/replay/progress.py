"""How far a recording has been read, on stderr."""

import sys
import time
from pathlib import Path
from typing import Final, Self

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

_EVERY_S: Final = 0.1


class Progress:
    """A bar by bytes of the file, where stderr is a terminal; what is printed comes out above it.

    Parameters
    ----------
    path
        The file.
    shown
        Whether a bar is wanted.
    """

    def __init__(self, path: Path, *, shown: bool) -> None:
        console = Console(stderr=True, highlight=False, markup=False)
        columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
        self._bar = Bar(*columns, console=console, transient=True, disable=not (shown and sys.stderr.isatty()))
        self._task = self._bar.add_task(path.name.replace("[", r"\["), total=path.stat().st_size)
        self._due_s = 0.0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def at(self, read_bytes: int) -> None:
        if not self._bar.disable and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + _EVERY_S
            self._bar.update(self._task, completed=read_bytes)

    def print(self, text: str) -> None:
        self._bar.console.print(text, soft_wrap=True)
