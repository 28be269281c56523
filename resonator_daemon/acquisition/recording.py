"""Writes what happens on a link to a file, in a thread of its own; whoever reads the link never waits for the disk."""

import json
import threading
import time
from collections import deque
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from mcap.writer import CompressionType, Writer

from resonator_daemon.acquisition.frames import BoardOnline
from resonator_daemon.acquisition.host_time import HostTime, read_host_time
from resonator_daemon.acquisition.recording_file import (
    BOARD,
    ENCODING,
    FORMAT,
    MARK_ENCODING,
    MARK_SCHEMA,
    MARK_SCHEMA_DATA,
    MARK_SCHEMA_ENCODING,
    MARKS,
    PROFILE,
    RECORDING,
    TOPIC,
    Mark,
    encode_mark,
    plate_fingerprints,
)
from resonator_daemon.acquisition.wire_events import Received, Sent, Skipped, Standing, WireEvent, encode
from resonator_daemon.errors import OperatorError
from resonator_daemon.plate import Plate

QUEUE_BYTES = 64 << 20  # 4 s of a plate with 3072 tones and 100 frames/s

_EVENT_BYTES = 300  # of memory, beside its data
_STANDING_BYTES = 10_000  # most of it vertices of the clock's hulls
_CHUNK_BYTES = 256 << 10  # compressed at once: about a millisecond
_BATCH_S = 0.1  # small batches: Python's lock would be held for long by large ones
_FLUSH_S = 1.0


class Recorder:
    """A recording that is being written; a file that is there already is left alone.

    After an error, as of the disk, nothing more is written: `failure` says so, and what was written stays readable.

    Parameters
    ----------
    path
        The file to be made.
    plate, link
        Written into it.
    queue_bytes
        Bound of the memory of events that wait to be written; what does not fit is counted, here and in the file.

    Raises
    ------
    OperatorError
        The file cannot be made.
    """

    def __init__(self, path: Path, plate: Plate, link: str, *, queue_bytes: int = QUEUE_BYTES) -> None:
        try:
            self._file: IO[bytes] = path.open("xb")
        except FileExistsError as error:
            raise OperatorError(f"{path} is there already, and nothing is overwritten; name another file") from error
        except OSError as error:
            raise OperatorError(f"{path} cannot be written: {error.strerror}") from error
        self._path = path
        self._queue_bytes = queue_bytes
        self._lock = threading.Lock()
        self._items: deque[WireEvent | Mark | BoardOnline] = deque()
        self._waiting_bytes = 0
        self._missing_events = self._missing_bytes = 0  # since the last event that fitted
        self._events = self._skipped_events = 0
        self._begun = False
        self._mark_channel: int | None = None
        self._failure: str | None = None
        self._closing = threading.Event()
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.LZ4)
        begun = {"format": FORMAT, "link": link, "version": version("resonatord"), **plate_fingerprints(plate)}
        self._thread = threading.Thread(target=self._run, args=(begun,), name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self.close()

    @property
    def failure(self) -> str | None:
        """Why nothing is written any more; None while all is well."""
        return self._failure

    @property
    def skipped_events(self) -> int:
        """Events that are not in the file, because the disk was too slow or failed."""
        with self._lock:
            return self._skipped_events

    @property
    def events(self) -> int:
        """Events that are in the file or wait to be written."""
        with self._lock:
            return self._events

    def put(self, event: WireEvent) -> None:
        """Have an event written; never waits. A `Standing` is of use, and written, at the beginning only."""
        size_bytes = _size_bytes(event)
        with self._lock:
            if isinstance(event, Standing) and self._begun:
                return
            if self._missing_events:
                size_bytes += _EVENT_BYTES  # the word of them comes first
            if self._failure is None and self._waiting_bytes + size_bytes <= self._queue_bytes:
                self._tell_missing(event.now)
                self._append(event)
                self._events += 1
                self._begun = True
            else:
                self._skip(event)

    def skip(self, event: WireEvent) -> None:
        """Count an event that cannot be of use in the file."""
        with self._lock:
            self._skip(event)

    def mark(self, mark: Mark) -> bool:
        """Have written what somebody said at that time; return whether there is room for it. Never waits."""
        with self._lock:
            fits = self._failure is None and self._waiting_bytes + _size_bytes(mark) <= self._queue_bytes
            if fits:
                self._append(mark)
            return fits

    def name_board(self, board: BoardOnline) -> None:
        """Have written which board it is, for whoever looks at the file."""
        with self._lock:
            if self._failure is None:
                self._items.append(board)

    def close(self) -> None:
        """Write what waits, and the end of the file; call it once the reader has stopped."""
        self._closing.set()
        self._thread.join()

    def _append(self, event: WireEvent | Mark) -> None:
        self._items.append(event)
        self._waiting_bytes += _size_bytes(event)

    def _tell_missing(self, now: HostTime) -> None:
        if self._missing_events:
            self._append(Skipped(now, self._missing_events, self._missing_bytes))
            self._missing_events = self._missing_bytes = 0

    def _skip(self, event: WireEvent) -> None:
        self._skipped_events += 1
        self._missing_events += 1
        self._missing_bytes += len(event.data) if isinstance(event, Received | Sent) else 0

    def _run(self, begun: dict[str, str]) -> None:
        try:
            with self._file:
                self._write(begun)
        except Exception as error:  # noqa: BLE001 - whoever records must hear of it, or would take the file for whole
            reason = (isinstance(error, OSError) and error.strerror) or repr(error)
            with self._lock:
                self._failure = f"{self._path}: {reason}: nothing more is recorded; what was written stays"
                for item in self._items:
                    if not isinstance(item, BoardOnline | Mark | Skipped):  # which was counted when it was made
                        self._skip(item)
                        self._events -= 1
                self._items.clear()

    def _write(self, begun: dict[str, str]) -> None:
        writer = self._writer
        writer.start(PROFILE, f"resonatord {begun['version']}")
        writer.add_metadata(RECORDING, begun)
        channel = writer.register_channel(TOPIC, ENCODING, schema_id=0)
        flush_s = 0.0
        closing = False
        while not closing:
            closing = self._closing.wait(_BATCH_S)
            with self._lock:
                if closing:  # nothing comes after them
                    self._tell_missing(read_host_time())
                items, self._items = self._items, deque()
            for item in items:
                if isinstance(item, BoardOnline):
                    writer.add_metadata(BOARD, _named(item))
                    continue
                now = item.now
                if isinstance(item, Mark):
                    writer.add_message(self._marks(), now.utc_ns, encode_mark(item), now.monotonic_ns)
                    continue
                writer.add_message(channel, now.utc_ns, encode(item), now.monotonic_ns)
            with self._lock:
                self._waiting_bytes -= sum(_size_bytes(item) for item in items if not isinstance(item, BoardOnline))
            if time.monotonic() >= flush_s:
                writer.flush()
                flush_s = time.monotonic() + _FLUSH_S
        writer.finish()

    def _marks(self) -> int:
        if self._mark_channel is None:
            schema = self._writer.register_schema(
                MARK_SCHEMA, MARK_SCHEMA_ENCODING, json.dumps(MARK_SCHEMA_DATA).encode()
            )
            self._mark_channel = self._writer.register_channel(MARKS, MARK_ENCODING, schema)
        return self._mark_channel


def _size_bytes(event: WireEvent | Mark) -> int:
    match event:
        case Received() | Sent():
            return _EVENT_BYTES + len(event.data)
        case Mark():
            return _EVENT_BYTES + len(event.text)
        case Standing():
            return _STANDING_BYTES
        case _:
            return _EVENT_BYTES


def _named(board: BoardOnline) -> dict[str, str]:
    identity = board.identity
    return {
        "product": identity.product,
        "serial_number": identity.serial_number,
        "firmware": identity.firmware,
        "boot_id": f"{board.boot_id:08x}",
    }
