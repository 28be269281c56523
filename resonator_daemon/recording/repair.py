"""Repair of recordings that were cut off or damaged: copies what is intact to a new file."""

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import IO, Final, NamedTuple, Self

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
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
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from resonator_daemon.errors import ExitCode, UserError
from resonator_daemon.host.new_file import NewFile, check_new
from resonator_daemon.host.system_limits import meaning_of, reason_of
from resonator_daemon.links.link import LinkUnavailableError
from resonator_daemon.recording.mcap_messages import (
    CHUNK_BYTES,
    MAX_CHUNK_BYTES,
    DamagedAttachment,
    chunk_data,
    read_attachment,
)
from resonator_daemon.recording.reader import (
    DAMAGE,
    MARKS,
    MAX_RECORD_BYTES,
    PLATE_FILE,
    SETTINGS_FILE,
    TOPIC,
    decode_mark,
    is_being_written,
    open_recording,
)
from resonator_daemon.session.host_time import HostTime
from resonator_daemon.session.link_events import Skipped, decode, encode

_FOOTER: Final = struct.Struct("<BQQQI8s")  # opcode, length, where summary and its offsets begin, crc, magic
_CRC_AND_MAGIC_BYTES: Final = 12  # what the summary's check sum leaves out


class DamagedRange(NamedTuple):
    """Damaged part of a file, a chunk or a message; `messages` by channel, from the index behind a chunk."""

    size_bytes: int
    messages: Counter[int]

    def joined(self, other: Self) -> "DamagedRange":
        """Return both as one."""
        return DamagedRange(self.size_bytes + other.size_bytes, self.messages + other.messages)


class FileIndex(NamedTuple):
    """Index at the end of a file; `records`: schemas and channels of it, which a damaged chunk may have held."""

    is_whole: bool
    records: tuple[Schema | Channel, ...] = ()


def read_index(file: IO[bytes]) -> FileIndex:
    """Read the index that other programs look for at the end of a file, and go back to the beginning."""
    index = FileIndex(is_whole=False)
    with suppress(*DAMAGE):
        end = file.seek(-_FOOTER.size, os.SEEK_END)
        footer = file.read(_FOOTER.size)
        opcode, _, begin, _, crc, magic = _FOOTER.unpack(footer)
        size_bytes = end - (begin or end)
        if opcode == Opcode.FOOTER and magic == MCAP0_MAGIC and 0 <= size_bytes <= MAX_RECORD_BYTES:
            file.seek(end - size_bytes)
            summary = file.read(size_bytes)
            if crc == zlib.crc32(footer[:-_CRC_AND_MAGIC_BYTES], zlib.crc32(summary)):
                records = StreamReader(BytesIO(summary + footer), skip_magic=True).records
                index = FileIndex(True, tuple(record for record in records if isinstance(record, Schema | Channel)))
            else:
                index = FileIndex(is_whole=not crc)  # written without a checksum
    file.seek(0)
    return index


class _BoundedReader(StreamReader):
    """Reads an attachment, or an index behind a chunk, from the bytes of its own record, whatever is in them."""

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        if opcode == Opcode.ATTACHMENT:
            return read_attachment(self._stream.read(length))
        if opcode != Opcode.MESSAGE_INDEX:
            record: McapRecord | None = super()._read_record(opcode, length)
            return record
        data = self._stream.read(length)
        with suppress(*DAMAGE):
            index: MessageIndex = MessageIndex.read(ReadDataStream(BytesIO(data)))
            return index
        return None


class Records:
    """Records one by one, those of chunks too, up to where none can be decoded any more.

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

    def __iter__(self) -> Iterator[McapRecord | DamagedRange]:
        hole: DamagedRange | None = None
        for record in self._outer():
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
                inner = breakup_chunk(replace(record, compression="", data=chunk_data(record)))
            except DAMAGE:
                hole = DamagedRange(min(record.uncompressed_size, MAX_CHUNK_BYTES), Counter())
            else:
                yield from inner
        if hole is not None:
            yield hole

    def _outer(self) -> Iterator[McapRecord]:
        reader = _BoundedReader(self._file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES)
        records = iter(reader.records)
        while True:
            try:
                record = next(records, None)
            except DAMAGE:
                return
            if record is None:
                self.ended = True
                return
            self.good_bytes = self._file.tell()
            yield record


class RepairError(UserError):
    """Nothing of the recording can be read, or its copy cannot be written."""

    exit_code = ExitCode.FAILED
    code = "not_repaired"


class NotRepairableError(RepairError):
    """The file is no recording of this format."""

    exit_code = ExitCode.USAGE
    code = "no_recording"


@dataclass
class Repaired:
    """What came of it; `cut_bytes` of the file's end are in no copy, nor are `holes` chunks before.

    `index_damaged`: the index at its end is not what was written, and other programs read the file by it.
    `unreadable` of the messages and marks of chunks that are whole, and of attachments, are in no copy, since no replay
    can read them; nor are `damaged_attachments`, by their names, which are not what was written. `carries_config`:
    plate file and settings are in it.
    """

    ended: bool = False
    cut_bytes: int = 0
    holes: int = 0
    index_damaged: bool = False
    unreadable: int = 0
    damaged_attachments: list[str] = field(default_factory=list)
    events: int = 0
    events_missing: int = 0
    last_event_utc_ns: int | None = None
    carries_config: bool = False

    @property
    def was_whole(self) -> bool:
        return self.ended and not (self.holes or self.index_damaged or self.unreadable or self.damaged_attachments)


def repair(path: Path, copy: Path) -> Repaired:
    """Copy what is whole of a recording; no copy is left where all of it is.

    A damaged chunk is left out, and so is what a replay could not read; an event in its place reports it. Where the
    frame of a record itself is damaged, what follows is cut.

    Raises
    ------
    RepairError
        It is no recording of this format, has no event, is being written, or the copy cannot be made.
    """
    try:
        with open_recording(str(path)):
            pass
        file = path.open("rb")
    except LinkUnavailableError as error:
        raise NotRepairableError(str(error)) from error
    except OSError as error:
        raise NotRepairableError(reason_of(error)) from error
    with file:
        if is_being_written(file):
            raise RepairError(f"{path} is being written; stop that first")
        check_new(copy)
        new = NewFile(copy)
        try:
            done = _copy(file, new.file)
            if not done.events:
                raise RepairError(f"{path} has no event that can be read; no copy is made")
            if done.was_whole:
                new.discard()
            else:
                new.keep()
        except OSError as error:
            new.discard()
            raise RepairError(f"{copy} cannot be written: {meaning_of(error)}") from error
        except BaseException:
            new.discard()
            raise
    return done


def _copy(file: IO[bytes], target: IO[bytes]) -> Repaired:
    index = read_index(file)
    copier = _Copier(target, index.records)
    records = Records(file)
    for record in records:
        copier.add(record)
    copier.finish()
    done = copier.done
    done.ended, done.index_damaged = records.ended, records.ended and not index.is_whole
    if not records.ended:
        done.cut_bytes = file.seek(0, os.SEEK_END) - records.good_bytes
    done.carries_config = copier.texts >= {PLATE_FILE, SETTINGS_FILE}
    return done


class _Copier:
    """Writes records to a new file, whose index is made again.

    Parameters
    ----------
    known
        Schemas and channels for messages whose data names none.
    """

    def __init__(self, target: IO[bytes], known: Iterable[Schema | Channel]) -> None:
        self._writer = Writer(target, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._begun = False
        self._schemas = {0: 0}  # here by the number there
        self._channels: dict[int, int] = {}
        self._topics: dict[int, str] = {}
        self._known_schemas = {record.id: record for record in known if isinstance(record, Schema)}
        self._known_channels = {record.id: record for record in known if isinstance(record, Channel)}
        self._hole: DamagedRange | None = None
        self.done = Repaired()
        self.texts: set[str] = set()

    def add(self, record: McapRecord | DamagedRange) -> None:
        match record:
            case DamagedRange():
                self.done.holes += 1
                self._miss(record)
            case Header() if not self._begun:
                self._begun = True
                self._writer.start(record.profile, record.library)
            case Metadata():
                self._writer.add_metadata(record.name, record.metadata)
            case DamagedAttachment():
                self.done.damaged_attachments.append(record.name)
            case Attachment():
                self._attach(record)
            case Schema():
                self._add_schema(record)
            case Channel():
                self._add_channel(record)
            case Message():
                if record.channel_id in self._known_channels and record.channel_id not in self._channels:
                    self._add_channel(self._known_channels[record.channel_id])
                if record.channel_id in self._channels:
                    self._message(record)

    def finish(self) -> None:
        if self._hole is not None:
            self.done.events_missing += self._missing(self._hole)
        self._writer.finish()

    def _attach(self, attachment: Attachment) -> None:
        try:
            attachment.data.decode()
        except UnicodeDecodeError:
            self.done.unreadable += 1
            return
        self.texts.add(attachment.name)
        self._writer.add_attachment(
            attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
        )

    def _add_schema(self, schema: Schema) -> None:
        if schema.id not in self._schemas:
            self._schemas[schema.id] = self._writer.register_schema(schema.name, schema.encoding, schema.data)

    def _add_channel(self, channel: Channel) -> None:
        if channel.id in self._channels:
            return
        if channel.schema_id not in self._schemas and channel.schema_id in self._known_schemas:
            self._add_schema(self._known_schemas[channel.schema_id])
        schema_id = self._schemas.get(channel.schema_id, 0)  # 0: none, which leaves its messages as they are
        self._channels[channel.id] = self._writer.register_channel(
            channel.topic, channel.message_encoding, schema_id, channel.metadata
        )
        self._topics[channel.id] = channel.topic

    def _message(self, message: Message) -> None:
        topic = self._topics[message.channel_id]
        try:
            if topic == TOPIC:
                decode(message.data, message.publish_time, message.log_time)
            elif topic == MARKS:
                decode_mark(message.data, message.publish_time, message.log_time)
        except DAMAGE:
            self.done.unreadable += 1
            self._miss(DamagedRange(len(message.data), Counter({message.channel_id: 1})))
            return
        if topic == TOPIC:
            if self._hole is not None:
                self._write_missing(self._hole, message)
                self._hole = None
            self.done.events += 1
            self.done.last_event_utc_ns = message.log_time
        self._writer.add_message(
            self._channels[message.channel_id], message.log_time, message.data, message.publish_time, message.sequence
        )

    def _miss(self, hole: DamagedRange) -> None:
        self._hole = hole if self._hole is None else self._hole.joined(hole)

    def _write_missing(self, hole: DamagedRange, following: Message) -> None:
        missing = self._missing(hole)
        self.done.events_missing += missing
        now = HostTime(following.publish_time, following.log_time - following.publish_time, 0)
        data = encode(Skipped(now, missing, hole.size_bytes))
        self._writer.add_message(self._channels[following.channel_id], now.utc_ns, data, now.monotonic_ns)

    def _missing(self, hole: DamagedRange) -> int:
        return sum(count for channel, count in hole.messages.items() if self._topics.get(channel) == TOPIC)
