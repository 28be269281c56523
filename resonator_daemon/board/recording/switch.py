"""Recording switched on and off while a link is read, also during a connection."""

import logging
import operator
import threading
from pathlib import Path

from resonator_daemon.base.errors import UserError
from resonator_daemon.board.recording.file_series import Series
from resonator_daemon.board.recording.reader import Mark, Origin
from resonator_daemon.board.recording.recorder import EVENT_BYTES, Recorder, RecordingCounts, size_bytes
from resonator_daemon.board.recording.writer import Published
from resonator_daemon.board.session.clock import read_host_time
from resonator_daemon.board.session.frames import BoardOnline
from resonator_daemon.board.session.link_events import Received, SnapshotTaken, WireEvent

log = logging.getLogger(__name__)

KEPT_BYTES = 8 << 20  # half a second of a plate with 3072 tones and 100 frames/s


class RecordingRunningError(UserError):
    """A recording runs already."""


class NothingRecordedError(UserError):
    """No recording runs, or the one that did has failed."""


class RecordingSwitch:
    """Recording of a reader's events that can be switched on and off.

    `put` receives every event.

    The last snapshot and the events since, about 100 ms, are kept in memory. A file begins with these, so that a
    replay can go on from there.

    Parameters
    ----------
    kept_bytes
        Bound of the memory of what has happened since. Beyond it, a recording begins with the next snapshot.

    Attributes
    ----------
    current
        What is being recorded; None where nothing is.
    """

    def __init__(self, *, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._switching = threading.Lock()  # held while a disk may be waited for
        self._lock = threading.Lock()
        self._kept: list[WireEvent] | None = []  # None: too much has happened
        self._size_bytes = 0
        self._board: BoardOnline | None = None
        self.current: Recorder | None = None
        self._last: Recorder | None = None  # that one, or the one that ran last: it still counts while it is closed
        self._before = RecordingCounts()  # of all earlier ones
        self._states: dict[str, Published] = {}
        self._awaits_snapshot = False

    def put(self, event: WireEvent) -> None:
        """Record one event, in the reader's thread; never waits for a disk."""
        with self._lock:
            if isinstance(event, SnapshotTaken):
                self._kept, self._size_bytes = [], 0
                self._awaits_snapshot = False
            if self.current is not None:
                if self._awaits_snapshot:
                    self.current.skip(event)
                else:
                    self.current.put(event)
            if self._kept is not None:
                self._kept.append(event)
                self._size_bytes += EVENT_BYTES + len(event.data) if isinstance(event, Received) else size_bytes(event)
                if self._size_bytes > self._kept_bytes:
                    self._kept = None

    def name_board(self, board: BoardOnline) -> None:
        """Set the board whose identity goes to the metadata of files."""
        with self._lock:
            self._board = board
            if self.current is not None:
                self.current.name_board(board)

    def publish(self, message: Published) -> None:
        """Hand a published message to the recording that runs, a retained one also to those that follow."""
        with self._lock:
            if message.retained:
                self._states[message.topic] = message
            if self.current is not None:
                self.current.publish(message)

    def start(self, place: Path | Series, origin: Origin) -> None:
        """Begin a recording.

        Raises
        ------
        RecordingRunningError
            One runs.
        UserError
            The file cannot be made, is there already, or there is no room for it, and the series does not begin late.
        """
        with self._switching:
            if self.current is not None:
                raise RecordingRunningError(f"{self.current.path} is being recorded; stop that first")
            recorder = Recorder(place, origin, log_line=log.log)
            with self._lock:
                for state in self._states.values():
                    recorder.publish(state)
                kept = self._kept or []
                counts = bool(kept) and isinstance(kept[0], SnapshotTaken) and kept[0].snapshot.running is not None
                if self._board is not None and counts:
                    recorder.name_board(self._board)
                for event in kept:
                    recorder.put(event)
                self._awaits_snapshot = self._kept is None
                self._before = self._all_counts()
                self.current = self._last = recorder

    def stop(self) -> Recorder | None:
        """End the recording and return it; waits for the disk. Return None where none ran."""
        with self._switching:
            with self._lock:
                recorder, self.current = self.current, None
            if recorder is not None:
                recorder.close()
            return recorder

    def mark(self, text: str) -> int:
        """Write a text into the file at the present time; return that time, in ns of UTC.

        Raises
        ------
        NothingRecordedError
            Nothing is being recorded.
        """
        now = read_host_time()
        with self._lock:
            if self.current is None:
                raise NothingRecordedError("nothing is being recorded; start a recording first")
            if self.current.failure is not None:
                raise NothingRecordedError(self.current.failure.text)
            if not self.current.mark(Mark(now, text)):
                raise NothingRecordedError(f"the disk of {self.current.path} is too slow to take the mark; try again")
        return now.utc_ns

    @property
    def totals(self) -> RecordingCounts:
        """What all recordings since this was made have come to; `file_bytes` is 0 while nothing is recorded."""
        with self._lock:
            totals = self._all_counts()
            return totals if self.current is not None else totals._replace(file_bytes=0)

    def _all_counts(self) -> RecordingCounts:
        if self._last is None:
            return self._before
        last = self._last.counts
        return RecordingCounts(*map(operator.add, self._before, last))._replace(file_bytes=last.file_bytes)
