"""One file of a recording while it is being written."""

import fcntl
import json
import operator
import os
from collections.abc import Mapping
from contextlib import suppress
from io import BufferedWriter
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, Self

from mcap.records import Schema
from mcap.writer import CompressionType, Writer

from resonator_daemon.base.errors import UserError, meaning_of
from resonator_daemon.base.host.files import NoNewFileError, sync_directory
from resonator_daemon.board.recording.mcap_messages import CHUNK_BYTES
from resonator_daemon.board.recording.reader import (
    BOARD,
    CHANNEL,
    DESCRIPTION_FILE,
    ENCODING,
    JSON_ENCODING,
    JSON_SCHEMA_ENCODING,
    MARK_SCHEMA,
    MARK_SCHEMA_DATA,
    MARKS,
    PROFILE,
    RECORDING,
    TOPIC,
    WIRE_CHANNEL,
    Mark,
    Origin,
    encode_mark,
)
from resonator_daemon.board.session.frames import BoardOnline
from resonator_daemon.board.session.link_events import Skipped, SnapshotTaken, WireEvent, encode

_TOML: Final = "application/toml"
_JSON: Final = "application/json"
SEQUENCE_MODULUS: Final = 1 << 32


class Published(NamedTuple):
    """A message that was published, as JSON; `topic` is its path below the plate's name.

    `schema` is that of the topic's payload. If `retained`, the last message of the topic holds until the next.
    """

    topic: str
    utc_ns: int
    payload: bytes
    schema: Mapping[str, Any]
    retained: bool


class Contents(NamedTuple):
    """Amounts in a part of a file; of its events, `traffic` are not about the recording itself.

    `frames` are those that its events complete, where they are counted.
    """

    events: int = 0
    traffic: int = 0
    messages: int = 0
    frames: int = 0

    def plus(self, other: Self) -> "Contents":
        return Contents(*map(operator.add, self, other))


class McapFile(Writer):
    """MCAP file of a recording: writes its beginning, and numbers the messages of each channel from 1.

    Parameters
    ----------
    stream
        Of the file.
    metadata
        Description of the recording.
    utc_ns
        Time of its attachment.
    """

    def __init__(self, stream: IO[bytes], metadata: dict[str, str], utc_ns: int = 0) -> None:
        super().__init__(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4, enable_data_crcs=True)
        self._numbers: dict[int, int] = {}
        self.start(PROFILE, f"resonatord {metadata['version']}")
        self.add_metadata(RECORDING, metadata)
        self.add_attachment(utc_ns, utc_ns, DESCRIPTION_FILE, _JSON, json.dumps(metadata).encode())
        self.channels = {TOPIC: self.register_channel(TOPIC, ENCODING, schema_id=0)}  # WIRE_CHANNEL

    def declare_channel(self, topic: str, encoding: str, schema: Schema | None) -> int:
        """Return the number of the channel of a topic, of which the first call declares it with encoding and schema."""
        if topic not in self.channels:
            # Outside of chunks: also found if the chunk with the channel's record is damaged.
            self.add_metadata(CHANNEL, {"id": str(len(self.channels) + WIRE_CHANNEL), "topic": topic})
            schema_id = 0 if schema is None else self.register_schema(schema.name, schema.encoding, schema.data)
            self.channels[topic] = self.register_channel(topic, encoding, schema_id)
        return self.channels[topic]

    def add_message(self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0) -> None:
        """Add a message, with the next number of its channel."""
        self._numbers[channel_id] = sequence = (self._numbers.get(channel_id, 0) + 1) % SEQUENCE_MODULUS
        super().add_message(channel_id, log_time, data, publish_time, sequence)


class RecordingWriter:
    """A file that is being written; its metadata are flushed to the kernel when it is made.

    For one thread. A lock (flock) marks the file as being written.

    Parameters
    ----------
    path
        The file to be made.
    origin
        Written into its beginning.
    utc_ns
        Now.

    Raises
    ------
    UserError
        It cannot be made, or is there already.

    Attributes
    ----------
    replayable
        It has an event that a replay can begin with.
    size_bytes
        What is written, without the chunk that is being filled.
    begun_ns
        Monotonic time of the first of these.
    whole, filling
        Contents of the chunks that are flushed to the kernel, and of the one that is being filled.
    snapshot_due
        A chunk has ended since the last snapshot was written.
    """

    def __init__(self, path: Path, origin: Origin, utc_ns: int) -> None:
        self.path = path
        self.replayable = False
        self.begun_ns = 0
        self.whole = self.filling = Contents()
        self.snapshot_due = False
        self.size_bytes = 0
        self._is_named = False  # on the medium
        self._file = _made(path)
        try:
            self._begin(origin, utc_ns)
        except OSError as error:
            self.abandon()
            raise UserError(f"{path} cannot be written: {meaning_of(error)}") from error

    @property
    def is_gone(self) -> bool:
        """Whether it is no longer under its name: it, or its directory, was removed, moved or replaced."""
        mine = os.fstat(self._file.fileno())
        try:
            there = os.stat(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return True
        return (there.st_dev, there.st_ino) != (mine.st_dev, mine.st_ino)

    def write(self, event: WireEvent) -> None:
        now = event.now
        if not self.replayable and not isinstance(event, Skipped):
            self.replayable, self.begun_ns = True, now.monotonic_ns
        if isinstance(event, SnapshotTaken):
            self.snapshot_due = False
        is_event = not isinstance(event, Skipped)
        contents = Contents(events=is_event, traffic=is_event and not isinstance(event, SnapshotTaken))
        self._add(WIRE_CHANNEL, now.utc_ns, encode(event), now.monotonic_ns, contents)

    def mark(self, mark: Mark) -> None:
        channel = self._json_channel(MARKS, MARK_SCHEMA, MARK_SCHEMA_DATA)
        self._add(channel, mark.now.utc_ns, encode_mark(mark), mark.now.monotonic_ns, Contents())

    def publish(self, message: Published) -> None:
        title = str(message.schema.get("title", message.topic))
        channel = self._json_channel(message.topic, title, message.schema)
        self._add(channel, message.utc_ns, message.payload, message.utc_ns, Contents(messages=1))

    def count_frames(self, number: int) -> None:
        """Count frames that the last event has completed; it is in the chunk before where this one has no event."""
        if self.filling.events:
            self.filling = self.filling.plus(Contents(frames=number))
        else:
            self.whole = self.whole.plus(Contents(frames=number))

    def name_board(self, board: BoardOnline) -> None:
        identity = board.identity
        self._writer.add_metadata(
            BOARD,
            {
                "product": identity.product,
                "serial_number": identity.serial_number,
                "firmware": identity.firmware,
                "boot_id": f"{board.boot_id:08x}",
            },
        )
        self._flush_records()

    def flush(self) -> None:
        """Hand what was written to the kernel."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._note_chunk()

    def finish(self) -> None:
        """Write the end of the file; `sync` and `close` are to follow."""
        self.flush()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        self.size_bytes = self._file.tell()

    def sync(self) -> None:
        """Wait until the medium has what was handed to the kernel; in any thread."""
        os.fdatasync(self._file.fileno())
        if not self._is_named:
            with suppress(FileNotFoundError):  # removed meanwhile
                sync_directory(self.path.parent)
            self._is_named = True

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def abandon(self, *, keep: bool = False) -> None:
        """Cut the file off after its last complete chunk and close it, or remove it: all it had counts as `filling`."""
        raw = self._file.raw
        if not keep:
            self.whole, self.filling = Contents(), self.whole.plus(self.filling)
        with suppress(OSError):
            if keep:
                raw.truncate(self.size_bytes)
            elif not self.is_gone:
                self.size_bytes = 0
                self.path.unlink()
        with suppress(OSError):
            raw.close()  # without the rest of the chunk, which closing the buffer would write once more

    def _begin(self, origin: Origin, utc_ns: int) -> None:
        with suppress(OSError):  # not every file system has locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._writer = McapFile(self._file, origin.metadata, utc_ns)
        for name, text in origin.attachments.items():  # outside of chunks, so that a file that was cut has them
            self._writer.add_attachment(utc_ns, utc_ns, name, _TOML, text.encode())
        self._flush_records()

    def _flush_records(self) -> None:
        """Hand what is outside of chunks to the kernel."""
        self._file.flush()
        self.size_bytes = self._file.tell()

    def _add(self, channel: int, log_ns: int, data: bytes, publish_ns: int, contents: Contents) -> None:
        self._writer.add_message(channel, log_ns, data, publish_ns)
        was_full = self._file.tell() != self.size_bytes
        if was_full:
            self._file.flush()
        self.filling = self.filling.plus(contents)
        if was_full:
            self._note_chunk()

    def _note_chunk(self) -> None:
        self.size_bytes = self._file.tell()
        self.whole, self.filling = self.whole.plus(self.filling), Contents()
        self.snapshot_due = True

    def _json_channel(self, topic: str, name: str, schema: Mapping[str, Any]) -> int:
        if topic in self._writer.channels:
            return self._writer.channels[topic]
        data = json.dumps(schema).encode()
        number = self._writer.declare_channel(topic, JSON_ENCODING, Schema(0, data, JSON_SCHEMA_ENCODING, name))
        self._flush_records()
        return number


def _made(path: Path) -> BufferedWriter:
    try:
        return path.open("xb")
    except FileExistsError as error:
        remedy = "choose a file in it" if path.is_dir() else "and nothing is overwritten; choose another file"
        raise NoNewFileError(f"{path} {'is a directory' if path.is_dir() else 'exists already'}, {remedy}") from error
    except OSError as error:
        raise NoNewFileError(f"{path} cannot be written: {meaning_of(error)}") from error
