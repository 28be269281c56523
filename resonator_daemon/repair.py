"""`resonatord repair`: copies what is whole of a recording that was cut off or damaged."""

import fcntl
import json
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, NamedTuple

from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    Schema,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from resonator_daemon.acquisition.host_time import HostTime
from resonator_daemon.acquisition.link import LinkUnavailableError
from resonator_daemon.acquisition.recording_file import DAMAGE, MAX_RECORD_BYTES, TOPIC, open_recording
from resonator_daemon.acquisition.recording_writer import CHUNK_BYTES
from resonator_daemon.acquisition.wire_events import Skipped, encode
from resonator_daemon.errors import ExitCode, OperatorError


class RepairError(OperatorError):
    """The file is no recording, or its copy cannot be written."""

    exit_code = ExitCode.FAILED


class _Hole(NamedTuple):
    """A chunk that is damaged; `messages` by channel, as the index behind it says."""

    size_bytes: int
    messages: dict[int, int]


class Repaired(NamedTuple):
    """What came of it; `cut_bytes` of the file's end are in no copy, nor are `holes` chunks before."""

    ended: bool
    cut_bytes: int
    holes: int
    events: int
    events_missing: int
    last_event_utc_ns: int | None

    @property
    def was_whole(self) -> bool:
        return self.ended and not self.holes


def repair(path: Path, output: Path | None, *, as_json: bool) -> None:
    """Copy what is whole of a recording to a file that is whole, and say what was cut; the original stays as it is.

    Where nothing is wrong no copy is made.

    Raises
    ------
    RepairError
        It is no recording of this format, is being written, or the copy cannot be made.
    """
    copy = output or path.with_name(f"{path.stem}-repaired.mcap")
    try:
        done = repaired(path, copy)
    except OperatorError as error:
        if as_json:
            told = {"code": "not_repaired", "message": str(error), "hint": ""}
            sys.stdout.write(json.dumps({"verb": "repair", "ok": False, "error": told}) + "\n")
        raise
    if as_json:
        made = None if done.was_whole else str(copy)
        sys.stdout.write(json.dumps({"verb": "repair", "ok": True, "output": made, **done._asdict()}) + "\n")
    sys.stderr.write(_sentence(path, copy, done) + "\n")


def repaired(path: Path, copy: Path) -> Repaired:
    """Copy what is whole of a recording; no copy is left where all of it is.

    A damaged chunk is left out, and an event in its place says so. Where the frame of a record itself is damaged, what
    follows is cut.

    Raises
    ------
    RepairError
        As of `repair`.
    """
    try:
        with open_recording(str(path)):
            pass
        file = path.open("rb")
    except (LinkUnavailableError, OSError) as error:
        raise RepairError(str(error)) from error
    with file:
        with suppress(PermissionError):  # a file system without locks
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise RepairError(f"{path} is being written; stop that first") from error
        try:
            target = copy.open("xb")
        except FileExistsError as error:
            raise RepairError(
                f"{copy} is there already, and nothing is overwritten; name another file with --output"
            ) from error
        except OSError as error:
            raise RepairError(f"{copy} cannot be written: {error.strerror}") from error
        whole = False
        try:
            with target:
                done = _copy(file, target)
                target.flush()
                os.fsync(target.fileno())
            whole = done.was_whole
        except OSError as error:
            whole = True
            raise RepairError(f"{copy} cannot be written: {error.strerror}") from error
        finally:
            if whole:
                copy.unlink(missing_ok=True)
    return done


def _copy(file: IO[bytes], target: IO[bytes]) -> Repaired:
    copier = _Copier(target)
    known = _known_channels(file)
    for record in known:
        copier.take(record)
    records = _Records(file)
    for found in records:
        copier.take(found)
    copier.finish()
    whole_bytes = file.seek(0, os.SEEK_END)
    return Repaired(
        records.ended,
        0 if records.ended else whole_bytes - records.good_bytes,
        copier.holes,
        copier.events,
        copier.events_missing,
        copier.last_event_utc_ns,
    )


def _known_channels(file: IO[bytes]) -> list[McapRecord]:
    """Return schemas and channels of the index at the end; a damaged chunk may have held them. None without an end."""
    known: list[McapRecord] = []
    with suppress(*DAMAGE):
        summary = make_reader(file).get_summary()
        if summary is not None:
            known = [*summary.schemas.values(), *summary.channels.values()]
    file.seek(0)
    return known


class _Records:
    """Records one by one, those of chunks too, up to where none can be told any more.

    Attributes
    ----------
    good_bytes : int
        Where the last record ended.
    ended : bool
        The file's own end was found.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.good_bytes = 0
        self.ended = False

    def __iter__(self) -> Iterator[McapRecord | _Hole]:
        reader = StreamReader(self._file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES)
        hole: _Hole | None = None
        with suppress(*DAMAGE):
            for record in reader.records:
                self.good_bytes = self._file.tell()
                if isinstance(record, MessageIndex):
                    if hole is not None:
                        hole.messages[record.channel_id] = len(record.records)
                    continue
                if hole is not None:
                    yield hole
                    hole = None
                if not isinstance(record, Chunk):
                    yield record
                    continue
                try:
                    inner = breakup_chunk(record, validate_crc=True)
                except DAMAGE:
                    hole = _Hole(record.uncompressed_size, {})
                else:
                    yield from inner
            self.ended = True
        if hole is not None:
            yield hole


class _Copier:
    """Writes records to a new file, whose index is made anew."""

    def __init__(self, target: IO[bytes]) -> None:
        self._writer = Writer(target, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._schemas = {0: 0}  # here by the number there
        self._channels: dict[int, int] = {}
        self._wire: int | None = None  # there
        self._hole: _Hole | None = None
        self.holes = self.events = self.events_missing = 0
        self.last_event_utc_ns: int | None = None

    def take(self, record: McapRecord | _Hole) -> None:
        match record:
            case _Hole():
                self.holes += 1
                before = self._hole
                self._hole = record if before is None else _joined(before, record)
            case Header():
                self._writer.start(record.profile, record.library)
            case Metadata():
                self._writer.add_metadata(record.name, record.metadata)
            case Attachment():
                self._writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )
            case Schema() if record.id not in self._schemas:
                self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
            case Channel() if record.id not in self._channels:
                self._channels[record.id] = self._writer.register_channel(
                    record.topic, record.message_encoding, self._schemas[record.schema_id], record.metadata
                )
                if record.topic == TOPIC:
                    self._wire = record.id
            case Message() if record.channel_id in self._channels:
                self._message(record)

    def finish(self) -> None:
        if self._hole is not None:
            self.events_missing += self._missing(self._hole)
        self._writer.finish()

    def _message(self, message: Message) -> None:
        if message.channel_id == self._wire:
            if self._hole is not None:
                self._tell(self._hole, message)
                self._hole = None
            self.events += 1
            self.last_event_utc_ns = message.log_time
        self._writer.add_message(
            self._channels[message.channel_id], message.log_time, message.data, message.publish_time, message.sequence
        )

    def _tell(self, hole: _Hole, following: Message) -> None:
        missing = self._missing(hole)
        self.events_missing += missing
        now = HostTime(following.publish_time, following.log_time - following.publish_time, 0)
        data = encode(Skipped(now, missing, hole.size_bytes))
        self._writer.add_message(self._channels[following.channel_id], now.utc_ns, data, now.monotonic_ns)

    def _missing(self, hole: _Hole) -> int:
        return hole.messages.get(self._wire, 0) if self._wire is not None else 0


def _joined(one: _Hole, other: _Hole) -> _Hole:
    channels = one.messages.keys() | other.messages.keys()
    messages = {channel: one.messages.get(channel, 0) + other.messages.get(channel, 0) for channel in channels}
    return _Hole(one.size_bytes + other.size_bytes, messages)


def _sentence(path: Path, copy: Path, done: Repaired) -> str:
    if done.was_whole:
        return f"{path} is whole: nothing to repair"
    wrong = []
    if not done.ended:
        wrong.append(f"its end is missing, and its last {done.cut_bytes} bytes are left out")
    if done.holes:
        wrong.append(f"{done.holes} damaged chunks with {done.events_missing} events are left out")
    end = "no event"
    if done.last_event_utc_ns is not None:
        moment = datetime.fromtimestamp(done.last_event_utc_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        end = f"{done.events} events up to {moment}.{done.last_event_utc_ns % 10**9 // 10**6:03d}Z"
    return f"{path}: {'; '.join(wrong)}; {copy} has {end}"
