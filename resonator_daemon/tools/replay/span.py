"""Which part of a recording is played out, from and to a time or a mark; and its progress, on stderr."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from resonator_daemon.base.errors import UsageError
from resonator_daemon.base.host.text import printable
from resonator_daemon.board.recording.reader import FilePath, Mark, open_recording
from resonator_daemon.board.session.clock import HostTime


@dataclass(frozen=True)
class Span:
    """A part of a recording, in its monotonic time; None: from its beginning, to its end.

    Parameters
    ----------
    begun
        When the recording begins.
    """

    begun: HostTime
    from_ns: int | None = None
    until_ns: int | None = None

    def is_before(self, now: HostTime) -> bool:
        return self.from_ns is not None and now.monotonic_ns < self.from_ns

    def is_over(self, now: HostTime) -> bool:
        return self.until_ns is not None and now.monotonic_ns >= self.until_ns

    @property
    def words(self) -> str:
        """Which part it is, in seconds after the beginning; empty of the whole."""
        return self._word("from", self.from_ns) + self._word("until", self.until_ns)

    def _word(self, word: str, at_ns: int | None) -> str:
        return "" if at_ns is None else f" {word} {(at_ns - self.begun.monotonic_ns) * 1e-9:.10g} s"


def find_span(path: FilePath, start: str | None, end: str | None) -> Span:
    """Look up where a part of a recording begins and ends; a text that is a number means seconds, else it is a mark's.

    Raises
    ------
    UsageError
        There is no such mark up to the end, or to the first damage; or the end is not after the beginning.
    LinkUnavailableError
        The file cannot be opened as a recording.
    """
    wanted = {text for text in (start, end) if text is not None and _seconds(text) is None}
    marks: dict[str, int] = {}  # the first of each text
    begun = HostTime(0, 0, 0)
    with open_recording(path) as recording:
        for number, entry in enumerate(recording.entries()):
            if number == 0:
                begun = entry.now
            if isinstance(entry, Mark):
                marks.setdefault(entry.text, entry.now.monotonic_ns)
            if wanted <= marks.keys():
                break
    for text in sorted(wanted - marks.keys()):
        there = ", ".join(repr(printable(mark)) for mark in marks) or "none"
        known = f"its marks: {there}. A number means seconds"
        raise UsageError(f"{path} has no mark {printable(text)!r}; {known}", code="no_mark")

    def place_ns(text: str | None) -> int | None:
        if text is None:
            return None
        seconds = _seconds(text)
        return marks[text] if seconds is None else begun.monotonic_ns + round(seconds * 1e9)

    from_ns, until_ns = place_ns(start), place_ns(end)
    if from_ns is not None and until_ns is not None and from_ns >= until_ns:
        from_s, until_s = ((at_ns - begun.monotonic_ns) * 1e-9 for at_ns in (from_ns, until_ns))
        nothing = f"--from is at {from_s:.10g} s, --until at {until_s:.10g} s of {path}: nothing lies between them"
        raise UsageError(f"{nothing}; give a later --until, or an earlier --from", code="no_span")
    return Span(begun, from_ns, until_ns)


def _seconds(text: str) -> float | None:
    try:
        seconds = float(text)
    except ValueError:
        return None
    return seconds if abs(seconds) < 1e9 else None


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
