"""Recording switched on and off while a link is read, also in the middle of a connection."""

import threading
from pathlib import Path
from typing import NamedTuple

from resonator_daemon.acquisition.frames import BoardOnline
from resonator_daemon.acquisition.host_time import HostTime, read_host_time
from resonator_daemon.acquisition.recording import Recorder
from resonator_daemon.acquisition.recording_file import Mark
from resonator_daemon.acquisition.wire_events import Received, Sent, Standing, WireEvent
from resonator_daemon.errors import OperatorError
from resonator_daemon.plate import Plate

KEPT_BYTES = 8 << 20  # half a second of a plate with 3072 tones and 100 frames/s

_EVENT_BYTES = 300  # of memory, beside its data


class RecordingRunningError(OperatorError):
    """A recording runs already."""


class NothingRecordedError(OperatorError):
    """No recording runs, or the one that did has failed."""


class RecordingNow(NamedTuple):
    """The recording that runs; `failure` says why nothing is written any more, None while all is well."""

    path: Path
    since_utc_ns: int
    failure: str | None


class RecordingSummary(NamedTuple):
    """A recording that has ended; `events_missing` are not in the file."""

    file: Path
    file_bytes: int
    events: int
    events_missing: int
    seconds: float
    failure: str | None


class RecordingSwitch:
    """Records what a reader's tap is handed, from and until whenever that is wanted.

    It remembers how the link stood last and what has happened since, which is about 100 ms: a file begins with these,
    so that a replay of it can go on from there.

    Parameters
    ----------
    kept_bytes
        Bound of the memory of what has happened since. Beyond it, a recording begins with the next standing.
    """

    def __init__(self, *, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._switching = threading.Lock()  # held while a disk may be waited for
        self._lock = threading.Lock()
        self._kept: list[WireEvent] | None = []  # None: too much has happened
        self._size_bytes = 0
        self._board: BoardOnline | None = None
        self._recorder: Recorder | None = None
        self._awaits_standing = False
        self._path = Path()
        self._since: HostTime | None = None

    def tap(self, event: WireEvent) -> None:
        """Take one event, in the reader's thread; never waits for a disk."""
        with self._lock:
            if isinstance(event, Standing):
                self._kept, self._size_bytes = [], 0
                self._awaits_standing = False
            if self._recorder is not None:
                if self._awaits_standing:
                    self._recorder.skip(event)
                else:
                    self._recorder.put(event)
            if self._kept is not None:
                self._kept.append(event)
                self._size_bytes += _EVENT_BYTES + (len(event.data) if isinstance(event, Received | Sent) else 0)
                if self._size_bytes > self._kept_bytes:
                    self._kept = None

    def name_board(self, board: BoardOnline) -> None:
        """Have files say which board counts, for whoever looks at them."""
        with self._lock:
            self._board = board
            if self._recorder is not None:
                self._recorder.name_board(board)

    def start(self, path: Path, plate: Plate, link: str) -> None:
        """Begin a recording.

        Raises
        ------
        RecordingRunningError
            One runs.
        OperatorError
            The file cannot be made, or is there already.
        """
        with self._switching:
            if self._recorder is not None:
                raise RecordingRunningError(f"{self._path} is being recorded; stop that first")
            recorder = Recorder(path, plate, link)
            with self._lock:
                self._path, self._since = path, read_host_time()
                kept = self._kept or []
                counts = bool(kept) and isinstance(kept[0], Standing) and kept[0].course.running is not None
                if self._board is not None and counts:
                    recorder.name_board(self._board)
                for event in kept:
                    recorder.put(event)
                self._awaits_standing = self._kept is None
                self._recorder = recorder

    def stop(self) -> RecordingSummary | None:
        """End the recording; waits for the disk. Return None where none ran."""
        with self._switching:
            with self._lock:
                recorder, self._recorder = self._recorder, None
                path, since = self._path, self._since
            if recorder is None or since is None:
                return None
            seconds = (read_host_time().monotonic_ns - since.monotonic_ns) * 1e-9
            recorder.close()
        file_bytes = path.stat().st_size if path.exists() else 0
        return RecordingSummary(
            path, file_bytes, recorder.events, recorder.skipped_events, round(seconds, 3), recorder.failure
        )

    def mark(self, text: str) -> int:
        """Write a text into the file at the present time; return that time, in ns of UTC.

        Raises
        ------
        NothingRecordedError
            Nothing is being recorded.
        """
        now = read_host_time()
        with self._lock:
            if self._recorder is None:
                raise NothingRecordedError("nothing is being recorded; start a recording first")
            if self._recorder.failure is not None:
                raise NothingRecordedError(self._recorder.failure)
            if not self._recorder.mark(Mark(now, text)):
                raise NothingRecordedError(f"the disk of {self._path} is too slow to take the mark; try again")
        return now.utc_ns

    @property
    def current(self) -> RecordingNow | None:
        """What is being recorded; None where nothing is."""
        with self._lock:
            if self._recorder is None or self._since is None:
                return None
            return RecordingNow(self._path, self._since.utc_ns, self._recorder.failure)

    def close(self) -> None:
        """End the recording, if one runs; call it once the reader has stopped."""
        self.stop()
