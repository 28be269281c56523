"""Writes link events to files in a thread of its own, so that the reader never waits for the disk."""

import errno
import logging
import threading
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Final, NamedTuple, Self

from resonator_daemon.base.errors import UserError, meaning_of
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.recording.file_series import DiskSpace, LogLine, NoRoomError, Series
from resonator_daemon.board.recording.reader import Mark, Origin
from resonator_daemon.board.recording.writer import Contents, Published, RecordingWriter
from resonator_daemon.board.session.clock import HostTime, read_host_time
from resonator_daemon.board.session.frames import BoardOnline
from resonator_daemon.board.session.link_events import Received, Sent, Skipped, SnapshotTaken, WireEvent

QUEUE_BYTES = 64 << 20  # 4 s of a plate with 3072 tones and 100 frames/s

_PUBLISHED_SHARE: Final = 2  # of the queue is for what was published, the rest for the link alone
_NAMES_APART_NS: Final = 1_000_000  # names have milliseconds

EVENT_BYTES: Final = 300  # of memory, besides its data

_SNAPSHOT_BYTES: Final = 10_000  # most of it vertices of the clock's hulls


class FrameCount(NamedTuple):
    """Number of frames that the event before it has completed."""

    number: int


Item = WireEvent | Mark | BoardOnline | Published | FrameCount


class RecorderTimes(NamedTuple):
    """Periods of writing and of flushing, and the pause before a new file after a failure."""

    batch_s: float = 0.1  # small batches: Python's lock would be held for long by large ones
    flush_s: float = 0.5  # with a batch, writing and an fsync of 0.3 s, less than the second that is promised
    retry_s: float = 10.0


TIMES = RecorderTimes()


class RecordingCounts(NamedTuple):
    """What a recording has come to; `file_bytes` is that of the present or last file, `messages` were published."""

    file_bytes: int = 0
    files: int = 0
    files_removed: int = 0
    events_missing: int = 0
    messages: int = 0
    messages_missing: int = 0


class Recorder:
    """A recording that is being written; a file that is there already is left alone.

    After an error, as of the disk, nothing more is written. `failure` has the reason; what was written stays readable.
    Where the series resumes, it goes on in a new file once it can, and `failure` is None again. A series goes from file
    to file where a `SnapshotTaken` is put: the next begins with it.

    Parameters
    ----------
    place
        The file to be made, or where a series of them goes.
    origin
        Written into the beginning of each.
    queue_bytes
        Bound of the memory of events that wait to be written; what does not fit is counted, here and in the file.
    log_line
        Receives level and text of lines for the log, in the thread that writes.
    times
        None: `TIMES`.
    needs_frame
        Remove a file that fails before a frame is in it; otherwise, before an event is.

    Attributes
    ----------
    path
        The file that is being written, or was last; the directory where none could be made yet.
    failure
        Why nothing is written any more; None while all is well.
    since : HostTime
        When it began.
    seconds : float
        How long it lasted, once it is closed.
    written : Contents
        What is flushed to the kernel; `frames` are 0 where `put` is not handed their numbers.
    counts : RecordingCounts
        What it has come to; what is missing did not fit, or the disk failed.

    Raises
    ------
    UserError
        The file cannot be made, or there is no room for it, and the series does not begin late.
    """

    def __init__(
        self,
        place: Path | Series,
        origin: Origin,
        *,
        queue_bytes: int = QUEUE_BYTES,
        log_line: LogLine = lambda _level, _text: None,
        times: RecorderTimes | None = None,
        needs_frame: bool = False,
    ) -> None:
        self._place = place
        self._origin = origin
        self._disk_space = DiskSpace(place, log_line) if isinstance(place, Series) else None
        self._resumes = isinstance(place, Series) and place.resumes
        self._log_line = log_line
        self._times = times or TIMES
        self._needs_frame = needs_frame
        self._queue_bytes = queue_bytes
        self._lock = threading.Lock()
        self._items: deque[Item] = deque()
        self._waiting_bytes = 0
        self._missing_events = self._missing_bytes = 0  # since the last event that fitted
        self.written = Contents()
        self.counts = RecordingCounts()
        self.failure: Reason | None = None
        self._logged = set[ReasonCode]()  # failures, each once, until a chunk is written again
        self.path = place if isinstance(place, Path) else place.directory
        self._closing = threading.Event()
        self._board: BoardOnline | None = None  # those of the thread: what each file begins with
        self._states: dict[str, Published] = {}
        self._begun_utc_ns = 0  # of the last file, as in its name
        self._retry_s = 0.0
        self._sync_thread = ThreadPoolExecutor(1, thread_name_prefix="recorder-sync")
        self._syncing: Future[None] | None = None  # of the present file
        self._sync_is_due = False
        self._ended_bytes, self._ended = 0, Contents()  # of the files before
        self._file: RecordingWriter | None = None
        self.since = read_host_time()
        self.seconds = 0.0
        try:
            self._begin_file(self.since.utc_ns)
        except UserError as error:
            if not (isinstance(place, Series) and place.begins_late):
                raise
            self._fail(_code(error), str(error))
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def all_bytes(self) -> int:
        """Of all its files."""
        with self._lock:
            return self._ended_bytes + self.counts.file_bytes

    def put(self, event: WireEvent, frames_before: int = 0) -> None:
        """Queue an event; never waits. A snapshot is written only where a replay can begin or go on with it.

        `frames_before` were completed by the event before it.
        """
        taken_bytes = size_bytes(event)
        with self._lock:
            if frames_before and not self._missing_events:
                self._append(FrameCount(frames_before))
            if self._missing_events:
                taken_bytes += EVENT_BYTES  # `Skipped` comes first
            fits = self._waiting_bytes + taken_bytes <= self._queue_bytes
            if fits and (self.failure is None or self._resumes):
                self._record_missing(event.now)
                self._append(event)
            elif not isinstance(event, SnapshotTaken):
                self._skip(event)

    def skip(self, event: WireEvent) -> None:
        """Count an event that cannot be of use in the file."""
        with self._lock:
            self._skip(event)

    def mark(self, mark: Mark) -> bool:
        """Queue a mark; return whether there is room for it. Never waits."""
        with self._lock:
            fits = self.failure is None and self._waiting_bytes + size_bytes(mark) <= self._queue_bytes
            if fits:
                self._append(mark)
            return fits

    def publish(self, message: Published) -> None:
        """Queue a published message for the channel of its topic; never waits.

        What does not fit is counted. Retained messages always fit; the files that follow begin with them, too.
        """
        with self._lock:
            fits = self._waiting_bytes + size_bytes(message) <= self._queue_bytes // _PUBLISHED_SHARE
            if fits or message.retained:
                self._append(message)
            else:
                self._count_missing(messages=1)

    def name_board(self, board: BoardOnline) -> None:
        """Queue the identity of the board for the metadata of the file."""
        with self._lock:
            self._append(board)

    def close(self) -> None:
        """Write what waits, and the end of the file; call it once the reader has stopped."""
        self.seconds = round((read_host_time().monotonic_ns - self.since.monotonic_ns) * 1e-9, 3)
        self._closing.set()
        self._thread.join()

    def _append(self, item: Item) -> None:
        self._items.append(item)
        self._waiting_bytes += size_bytes(item)

    def _record_missing(self, now: HostTime) -> None:
        if self._missing_events:
            self._append(Skipped(now, self._missing_events, self._missing_bytes))
            self._missing_events = self._missing_bytes = 0

    def _skip(self, event: WireEvent) -> None:
        self._count_missing(events=1)
        self._missing_events += 1
        self._missing_bytes += len(event.data) if isinstance(event, Received | Sent) else 0

    def _count_missing(self, *, events: int = 0, messages: int = 0) -> None:
        counts = self.counts
        self.counts = counts._replace(
            events_missing=counts.events_missing + events, messages_missing=counts.messages_missing + messages
        )

    def _run(self) -> None:
        look_s = 0.0
        closing = False
        while not closing:
            closing = self._closing.wait(self._times.batch_s)
            with self._lock:
                if closing:  # nothing comes after them
                    self._record_missing(read_host_time())
                items, self._items = self._items, deque()
            self._write(items)
            if time.monotonic() >= look_s:
                self._flush()
                self._sync_is_due = True
                look_s = time.monotonic() + self._times.flush_s
            self._begin_sync()
        self._end_file()
        self._sync_thread.shutdown()

    def _write(self, items: deque[Item]) -> None:
        events_missing = messages_missing = 0
        for item in items:
            if self._write_one(item):
                continue
            if isinstance(item, Published):
                messages_missing += 1
            elif not isinstance(item, Mark | BoardOnline | FrameCount | Skipped | SnapshotTaken):
                events_missing += 1
        self._update_counts()
        with self._lock:
            self._count_missing(events=events_missing, messages=messages_missing)
            self._waiting_bytes -= sum(map(size_bytes, items))

    def _write_one(self, item: Item) -> bool:
        """Write one item; return whether it is in a file."""
        try:
            match item:
                case BoardOnline():
                    self._board = item
                case Published(retained=True):
                    self._states[item.topic] = item
                case SnapshotTaken():
                    self._turn_over(item)
            file = self._file
            if file is None or (isinstance(item, SnapshotTaken) and not _is_of_use(item, file)):
                return False
            match item:
                case BoardOnline():
                    file.name_board(item)
                case Mark():
                    file.mark(item)
                case Published():
                    file.publish(item)
                case FrameCount():
                    file.count_frames(item.number)
                case _:
                    file.write(item)
        except Exception as error:  # noqa: BLE001 - it is reported, or the file would be taken for whole
            self._break_off(error)
            return False
        return True

    def _turn_over(self, snapshot: SnapshotTaken) -> None:
        """Begin the next file, where it is its turn."""
        if not isinstance(self._place, Series):
            return
        if self._file is not None:
            if not self._place.is_over(self._file, snapshot.now.monotonic_ns):
                return
            self._end_file()
        elif not self._resumes or time.monotonic() < self._retry_s:
            return
        try:
            self._begin_file(snapshot.now.utc_ns)
        except UserError as error:
            self._fail(_code(error), str(error))
            return
        if self._board is not None and snapshot.snapshot.running is not None and self._file is not None:
            self._file.name_board(self._board)

    def _begin_file(self, utc_ns: int) -> None:
        if isinstance(self._place, Path):
            file = RecordingWriter(self._place, self._origin, utc_ns)
        else:
            # The order of names is that of age, also where the host's clock was set back.
            utc_ns = self._begun_utc_ns = max(utc_ns, self._begun_utc_ns + _NAMES_APART_NS)
            if self._disk_space is not None:
                self._disk_space.check(again=self.failure is not None)
                self._disk_space.begin()
            file = self._place.make(self._origin, utc_ns)
        for state in self._states.values():
            file.publish(state)
        file.filling = Contents()  # these were counted in the file before
        with self._lock:
            self.failure = None
            self._path_before, self.path, self._file = self.path, file.path, file
            self._ended_bytes += self.counts.file_bytes
            self._ended = self.written
            self.counts = self.counts._replace(files=self.counts.files + 1, file_bytes=file.size_bytes)

    def _flush(self) -> None:
        """Flush what was written to the kernel, and check the free space of the disk."""
        if self._file is None:
            return
        try:
            self._file.flush()
            if self._file.is_gone:
                self._leave()
                return
            if self._disk_space is not None:
                self._disk_space.remove_oldest(self._file)
                self._disk_space.check(again=False)
        except UserError as error:
            self._end_file()
            self._fail(_code(error), str(error))
        except Exception as error:  # noqa: BLE001 - as above
            self._break_off(error)
        self._update_counts()

    def _leave(self) -> None:
        """End a file that is no longer under its name; where the series resumes, the next begins as soon as it can."""
        self._end_file()
        then = "a new file is begun as soon as that can be" if self._resumes else "nothing more is recorded"
        self._report_failure(ReasonCode.FILE_GONE, f"{self.path} was removed, moved or replaced: {then}")
        self._retry_s = 0.0

    def _update_counts(self) -> None:
        with self._lock:
            if self._file is not None:
                self.written = self._ended.plus(self._file.whole)
                self.counts = self.counts._replace(file_bytes=self._file.size_bytes, messages=self.written.messages)
            if self._disk_space is not None:
                self.counts = self.counts._replace(files_removed=self._disk_space.files_removed)
        if self._logged and self._file is not None and self._is_to_keep(self._file):
            self._logged.clear()
            self._log_line(logging.INFO, f"recording goes on in {self.path}")

    def _begin_sync(self) -> None:
        """Have the medium take what was flushed, unless it still takes what was before; nothing waits for it."""
        if self._file is None or (self._syncing is not None and not self._syncing.done()):
            return
        if self._syncing is not None and (error := self._syncing.exception()) is not None:
            self._break_off(error)
        elif self._sync_is_due:
            self._sync_is_due = False
            self._syncing = self._sync_thread.submit(self._file.sync)

    def _end_file(self) -> None:
        """Write the end of the file; the medium may take seconds for it, which nothing else waits for."""
        if self._file is None:
            return
        try:
            self._file.finish()
            self._update_counts()
        except Exception as error:  # noqa: BLE001 - as above
            self._break_off(error)
            return
        file, self._file, self._syncing = self._file, None, None
        self._sync_thread.submit(self._close, file)

    def _close(self, file: RecordingWriter) -> None:
        try:
            file.sync()
        except OSError as error:
            self._log_line(logging.WARNING, f"{file.path} may not be on the disk: {meaning_of(error)}")
        finally:
            file.close()

    def _break_off(self, error: BaseException) -> None:
        """Leave a file as it is that takes nothing more."""
        if self._syncing is not None:
            wait([self._syncing])  # it uses the file
            self._syncing = None
        text = f"{self.path}: {meaning_of(error) if isinstance(error, OSError) else repr(error)}"
        kept = "what was written stays"
        if self._file is not None:
            is_kept = self._is_to_keep(self._file)
            self._file.abandon(keep=is_kept)
            self._update_counts()
            lost, self._file = self._file.filling, None
            with self._lock:
                self._count_missing(events=lost.traffic, messages=lost.messages)
                if not is_kept:
                    kept = f"the file has no {'frame' if self._needs_frame else 'event'} and is removed"
                    self.path = self._path_before
                    self.counts = self.counts._replace(files=self.counts.files - 1)
        self._fail(_code(error), text, kept)

    def _is_to_keep(self, file: RecordingWriter) -> bool:
        """Whether enough of a file is written to keep it after a failure."""
        return (file.whole.frames if self._needs_frame else file.whole.events) > 0

    def _fail(self, code: ReasonCode, text: str, kept: str = "what was written stays") -> None:
        then = f"it is tried again every {self._times.retry_s:g} s" if self._resumes else "nothing more is recorded"
        self._report_failure(code, f"{text}: {then}; {kept}")

    def _report_failure(self, code: ReasonCode, text: str) -> None:
        with self._lock:
            self.failure = Reason(code, text)
        self._retry_s = time.monotonic() + self._times.retry_s
        if code not in self._logged:
            self._logged.add(code)
            self._log_line(logging.WARNING, text)


def _code(error: BaseException) -> ReasonCode:
    cause = error.__cause__ or error
    is_full = isinstance(error, NoRoomError) or (isinstance(cause, OSError) and cause.errno == errno.ENOSPC)
    return ReasonCode.DISK_FULL if is_full else ReasonCode.WRITE_FAILED


def _is_of_use(snapshot: SnapshotTaken, file: RecordingWriter) -> bool:
    """Whether a replay could begin with it or, where the chunk before is damaged, go on with the open link."""
    return not file.replayable or (file.snapshot_due and snapshot.snapshot.running is not None)


def size_bytes(item: Item) -> int:
    """Return about what an item takes of memory while it waits."""
    match item:
        case Received(data=content) | Sent(data=content) | Published(payload=content):
            return EVENT_BYTES + len(content)
        case Mark():
            return EVENT_BYTES + len(item.text)
        case SnapshotTaken():
            return _SNAPSHOT_BYTES
    return 0 if isinstance(item, BoardOnline) else EVENT_BYTES
