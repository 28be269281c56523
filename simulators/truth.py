"""The truth next to the bytes: what pressed during each frame, one JSON object a line, into a file or a pipe."""

import errno
import os
import stat
from functools import lru_cache
from pathlib import Path

from simulators.board import MadeFrame
from simulators.plate import Contact

_CONTACTS_CACHED = 64  # of a touch that holds still, and of a whole plate: one line is like the last
_WAITING_LIMIT_BYTES = 4 * 1024 * 1024  # for a reader that pauses: some ten seconds at 1 kHz


class TruthOutput:
    """Truth file or named pipe; `write` never waits for a reader.

    Lines that nobody was there to read, and those that came while a reader was too far behind, are lost and counted in
    `lines_lost`. A reader may come at any time, leave and come back.

    Raises
    ------
    OSError
        The file cannot be opened or, later, written.
    """

    def __init__(self, path: Path) -> None:
        self.lines_lost = 0
        self._path = path
        self._waiting = bytearray()
        self._is_pipe = path.exists() and stat.S_ISFIFO(path.stat().st_mode)
        self._fd: int | None = None
        if not self._is_pipe:
            try:
                self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
            except OSError as error:
                raise self._not_written(error) from error

    def write(self, lines: str) -> None:
        if self._is_pipe and (self._reader_fd() is None or len(self._waiting) + len(lines) > _WAITING_LIMIT_BYTES):
            self.lines_lost += lines.count("\n")
            return
        self._waiting += lines.encode()
        self._flush()

    def close(self) -> None:
        try:
            self._flush()
        finally:
            self._let_go()

    def _reader_fd(self) -> int | None:
        if self._fd is None:
            try:
                self._fd = os.open(self._path, os.O_WRONLY | os.O_NONBLOCK)
            except OSError as error:
                if error.errno not in (errno.ENXIO, errno.ENOENT):  # nobody reads yet, or the pipe was removed
                    raise
        return self._fd

    def _flush(self) -> None:
        try:
            while self._waiting and self._fd is not None:
                del self._waiting[: os.write(self._fd, self._waiting)]
        except BlockingIOError:
            pass
        except BrokenPipeError:
            self._let_go()
        except OSError as error:
            raise self._not_written(error) from error

    def _not_written(self, error: OSError) -> OSError:
        return type(error)(f"the truth cannot be written to {self._path}: {error.strerror}")

    def _let_go(self) -> None:
        self.lines_lost += self._waiting.count(b"\n")
        self._waiting.clear()
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


def truth_line(frame: MadeFrame, t_ns: int) -> str:
    """Return the line of a frame whose gate ended at `t_ns`, UTC."""
    contacts = ", ".join(map(_contact, frame.contacts))
    return (
        f'{{"sequence": {frame.sequence}, "board_ticks": {frame.board_ticks}, "t_ns": "{t_ns}", '
        f'"contacts": [{contacts}], "plate_kelvin": {frame.plate_kelvin!r}}}\n'
    )


@lru_cache(_CONTACTS_CACHED)
def _contact(contact: Contact) -> str:
    (x, y), (force_x, force_y, force_z) = contact.position_m, contact.force_newton
    site, radius_m, friction = (
        "null" if value is None else repr(value)
        for value in (contact.site, contact.radius_m, contact.friction_coefficient)
    )
    text = (
        f'{{"id": {contact.id}, "site": {site}, "position_m": [{x!r}, {y!r}], '
        f'"force_newton": [{force_x!r}, {force_y!r}, {force_z!r}], "radius_m": {radius_m}'
    )
    if contact.friction_coefficient is not None:
        text += f', "stick_radius_m": {contact.stick_radius_m!r}, "friction_coefficient": {friction}'
    return text + "}"
