"""Board reader for a caller that waits in its own thread."""

import threading
from typing import Any, Self

from resonator_daemon.base.plate import Plate
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.session.board_reader import BoardReader
from resonator_daemon.board.session.frames import Arrival


class BlockingReader:
    """Reads a board from entry to exit.

    Parameters
    ----------
    target
        Link of the board.
    plate
    options
        Of `BoardReader`.

    Attributes
    ----------
    reader
    """

    def __init__(self, target: LinkTarget, plate: Plate, **options: Any) -> None:
        self._arrived = threading.Event()
        self.reader = BoardReader(target, plate, self._arrived.set, **options)

    def __enter__(self) -> Self:
        self.reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.stop()

    def wait(self, timeout_s: float) -> list[Arrival]:
        """Wait until something arrives, for `timeout_s` at most; return what has arrived."""
        self._arrived.wait(timeout_s)
        self._arrived.clear()
        return self.reader.pop_arrivals()
