"""Repair of recordings that were cut off or damaged: copies what is intact to a new file."""

import json
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import IO, Final, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from resonator_daemon.base.errors import ExitCode, UserError, meaning_of
from resonator_daemon.base.host.files import NewFile, check_new
from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.recording.mcap_messages import (
    MAX_RECORD_BYTES,
    READ_ERRORS,
    Damage,
    DamagedAttachment,
    IndexedMessages,
    read_records,
)
from resonator_daemon.board.recording.reader import (
    CHANNEL,
    DESCRIPTION_FILE,
    JSON_ENCODING,
    PLATE_FILE,
    PROFILE,
    RECORDING,
    SETTINGS_FILE,
    TOPIC,
    WIRE_CHANNEL,
    check_format,
    is_being_written,
    no_recording,
    open_file,
)
from resonator_daemon.board.recording.writer import SEQUENCE_MODULUS, McapFile
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.link_events import Skipped, decode, encode

_FOOTER: Final = struct.Struct("<BQQQI8s")  # opcode, length, where summary and its offsets begin, crc, magic
_CRC_AND_MAGIC_BYTES: Final = 12  # that the summary's checksum does not cover
_DATA_END_BYTES: Final = 13
_SKIPPED: Final = encode(Skipped(HostTime(0, 0, 0), 0, 0))[:1]
_BEGINNING_BYTES: Final = 4096  # with header, metadata and attachments, each of which contains the profile


class FileIndex(NamedTuple):
    """Index at the end of a file; `begin_bytes`: its position, None if it is damaged or missing."""

    begin_bytes: int | None = None
    channels: tuple[Channel, ...] = ()
    schemas: tuple[Schema, ...] = ()
    message_counts: dict[int, int] | None = None


def read_index(file: IO[bytes]) -> FileIndex:
    """Read the index at the end of a file, by which other programs read the file."""
    with suppress(*READ_ERRORS):
        end = file.seek(-_FOOTER.size, os.SEEK_END)
        footer = file.read(_FOOTER.size)
        opcode, _, begin, _, crc, magic = _FOOTER.unpack(footer)
        if opcode == Opcode.FOOTER and magic == MCAP0_MAGIC and 0 < end - begin <= MAX_RECORD_BYTES:
            file.seek(begin)
            summary = file.read(end - begin)
            if crc == zlib.crc32(footer[:-_CRC_AND_MAGIC_BYTES], zlib.crc32(summary)):
                records = list(StreamReader(BytesIO(summary + footer), skip_magic=True).records)
                return FileIndex(
                    begin,
                    tuple(record for record in records if isinstance(record, Channel)),
                    tuple(record for record in records if isinstance(record, Schema)),
                    next((record.channel_message_counts for record in records if isinstance(record, Statistics)), None),
                )
    return FileIndex()


class RepairError(UserError):
    """Nothing of the recording can be read, or its copy cannot be written."""

    exit_code = ExitCode.FAILED
    code = "not_repaired"


@dataclass
class RepairResult:
    """Result of a repair.

    The copy lacks `cut_bytes` at the end of the file, `damaged_bytes` of `damaged_parts` before it, and the
    `damaged_attachments`, given by name. `index_damaged`: other programs cannot rely on the file's index.
    `carries_config`: the copy has plate file and settings. `recovered` and `missing` are numbers of messages by topic;
    those of the link are `events` and `events_missing`. Messages after a missing end are unknown, and not counted.
    `events_missing_before`: those that the file itself reports, as of a slow disk or an earlier repair.
    """

    ended: bool = False
    cut_bytes: int = 0
    damaged_parts: int = 0
    damaged_bytes: int = 0
    index_damaged: bool = False
    damaged_attachments: list[str] = field(default_factory=list)
    events: int = 0
    events_missing: int = 0
    events_missing_before: int = 0
    recovered: dict[str, int] = field(default_factory=dict)
    missing: dict[str, int] = field(default_factory=dict)
    last_event_utc_ns: int | None = None
    carries_config: bool = False

    @property
    def was_whole(self) -> bool:
        damaged = self.damaged_parts or self.index_damaged or self.damaged_attachments
        return self.ended and not (damaged or any(self.missing.values()))


def repair(path: Path, copy: Path) -> RepairResult:
    """Copy the intact part of a recording; if all of it is intact, no copy is kept.

    A damaged chunk is omitted; an event in its place reports it.

    Raises
    ------
    RepairError
        It is no recording of this format, has no event, is being written, or the copy cannot be made.
    """
    try:
        with open_file(str(path)) as file:
            if is_being_written(file):
                raise RepairError(f"{path} is being written; stop that first")
            index = read_index(file)
            records = read_records(file, end_bytes=index.begin_bytes)
            head = _head(path, file, records)
            description = _description(path, head)
            check_new(copy)
            new = NewFile(copy)
            try:
                done = _Copier(new.file, description, index).copy(chain(head, records), file)
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
    except LinkUnavailableError as error:
        raise RepairError(str(error), code="no_recording", exit_code=ExitCode.USAGE) from error
    return done


def _head(path: Path, file: IO[bytes], records: Iterator[McapRecord]) -> list[McapRecord]:
    """Read the records up to the first intact chunk."""
    file.seek(0)
    if PROFILE.encode() not in file.read(_BEGINNING_BYTES):  # large files of other programs are not searched
        raise no_recording(str(path))
    head: list[McapRecord] = []
    for record in records:
        head.append(record)
        if isinstance(record, Chunk):
            break
    return head


def _description(path: Path, head: list[McapRecord]) -> dict[str, str]:
    """Return the metadata of a recording: from the attachment, which has a checksum, otherwise from their record."""
    found: list[dict[str, str]] = []
    for record in head:
        if isinstance(record, Attachment) and record.name == DESCRIPTION_FILE:
            with suppress(*READ_ERRORS):
                found.append(dict(json.loads(record.data)))
        elif isinstance(record, Metadata) and record.name == RECORDING:
            found.insert(0, record.metadata)
    if not found:
        raise no_recording(str(path))
    check_format(str(path), found[-1])
    return found[-1]


class _Copier:
    """Copies the records of a recording to a new file with a new index.

    Parameters
    ----------
    target
        The new file.
    description
        Metadata of the recording.
    index
        Index of the recording; has schemas and channels that damaged chunks may have contained.
    """

    def __init__(self, target: IO[bytes], description: dict[str, str], index: FileIndex) -> None:
        self._index = index
        self._writer = McapFile(target, description)
        self._schemas = {schema.id: schema for schema in index.schemas}
        self._channels = {WIRE_CHANNEL: Channel(WIRE_CHANNEL, TOPIC, "", {}, 0)}
        self._channels |= {channel.id: channel for channel in index.channels}
        self._passed = Counter[int]()  # messages of each channel so far, recovered or missing
        self._recovered = Counter[int]()
        self._indexed = Counter[int]()  # messages since then, by indexes of damaged chunks, or of unknown channels
        self._in_chunk = Counter[int]()  # messages of the last intact chunk
        self._skipped_bytes = 0  # damaged bytes since the last event
        self._last_event: HostTime | None = None
        self.done = RepairResult()
        self._texts: set[str] = set()

    def copy(self, records: Iterable[McapRecord], file: IO[bytes]) -> RepairResult:
        """Copy these records of a file."""
        done, data_crc = self.done, 0
        damage: Damage | None = None  # no intact record has followed it yet
        for record in records:
            if damage is not None:
                self._note_damage(damage)
            damage = record if isinstance(record, Damage) else None
            if isinstance(record, DataEnd):
                done.ended, data_crc = True, record.data_section_crc
            else:
                self._add(record)
        if damage is not None and self._index.begin_bytes is None:
            done.cut_bytes = damage.end_bytes - damage.begin_bytes
        elif damage is not None:
            done.ended = True
            self._note_damage(damage)
        self._add_missing_at_end()
        self._count()
        done.index_damaged = done.ended and self._index.begin_bytes is None
        if done.was_whole and data_crc and _crc_of(file, self._index) != data_crc:
            done.damaged_parts += 1  # in a record without a checksum of its own
        done.carries_config = self._texts >= {PLATE_FILE, SETTINGS_FILE}
        self._writer.finish()  # type: ignore[no-untyped-call]
        return done

    def _count(self) -> None:
        written = self._index.message_counts
        if written is None:
            written = self._passed + self._indexed
        for number in sorted(written.keys() | self._recovered.keys()):
            topic = self._channels[number].topic if number in self._channels else str(number)
            self.done.recovered[topic] = self._recovered[number]
            self.done.missing[topic] = max(0, written.get(number, 0) - self._recovered[number])
        self.done.events, self.done.events_missing = self.done.recovered.get(TOPIC, 0), self.done.missing.get(TOPIC, 0)

    def _add(self, record: McapRecord) -> None:
        match record:
            case Metadata() if record.name == CHANNEL:
                with suppress(*READ_ERRORS):
                    number = int(record.metadata["id"])
                    self._channels.setdefault(number, Channel(number, record.metadata["topic"], JSON_ENCODING, {}, 0))
            case Metadata() if record.name != RECORDING:
                self._writer.add_metadata(record.name, record.metadata)
            case DamagedAttachment():
                self.done.damaged_attachments.append(record.name)
            case Attachment() if record.name != DESCRIPTION_FILE:
                self._texts.add(record.name)
                self._writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )
            case IndexedMessages():
                if self._in_chunk.pop(record.channel_id, None) != record.count and self._skipped_bytes:
                    self._indexed[record.channel_id] += record.count
            case Chunk():
                self._add_chunk(record)

    def _add_chunk(self, chunk: Chunk) -> None:
        self._in_chunk.clear()
        try:
            records = breakup_chunk(chunk)
        except READ_ERRORS as error:
            self._note_damage(Damage(0, len(chunk.data), error))
            return
        for record in records:
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
            elif isinstance(record, Message):
                self._in_chunk[record.channel_id] += 1
                self._message(record)

    def _note_damage(self, damage: Damage) -> None:
        size_bytes = damage.end_bytes - damage.begin_bytes
        self.done.damaged_parts += 1
        self.done.damaged_bytes += size_bytes
        self._skipped_bytes += size_bytes

    def _message(self, message: Message) -> None:
        number = message.channel_id
        channel = self._channels.get(number)
        if channel is None:
            self._indexed[number] += 1
            return
        # Recordings of earlier versions have no numbers.
        lost = self._indexed.pop(number, 0)
        if message.sequence:
            lost = (message.sequence - self._passed[number] - 1) % SEQUENCE_MODULUS
        self._passed[number] += lost + 1
        self._recovered[number] += 1
        if channel.topic == TOPIC:
            now = HostTime(message.publish_time, message.log_time - message.publish_time, 0)
            if lost or (self._skipped_bytes and not message.sequence):
                self._add_skipped(now, lost)
            self._skipped_bytes = 0
            self._last_event = now
            if message.data[:1] == _SKIPPED:
                with suppress(*READ_ERRORS):
                    event = decode(message.data, message.publish_time, message.log_time)
                    self.done.events_missing_before += event.events if isinstance(event, Skipped) else 0
            self.done.last_event_utc_ns = message.log_time
        copied = self._writer.declare_channel(
            channel.topic, channel.message_encoding, self._schemas.get(channel.schema_id)
        )
        self._writer.add_message(copied, message.log_time, message.data, message.publish_time)

    def _add_missing_at_end(self) -> None:
        """Report events that were lost after the last intact one, as the index or records of their chunk count them."""
        written = self._index.message_counts
        lost = self._indexed[WIRE_CHANNEL]
        if written is not None:
            lost = written.get(WIRE_CHANNEL, 0) - self._passed[WIRE_CHANNEL]
        if self._last_event is not None and (lost > 0 or (self._skipped_bytes and written is None)):
            self._add_skipped(self._last_event, lost)

    def _add_skipped(self, now: HostTime, events: int) -> None:
        data = encode(Skipped(now, events, self._skipped_bytes))
        self._writer.add_message(WIRE_CHANNEL, now.utc_ns, data, now.monotonic_ns)


def _crc_of(file: IO[bytes], index: FileIndex) -> int:
    """Return the checksum of all records before the end of the data."""
    left_bytes = (index.begin_bytes or 0) - _DATA_END_BYTES
    file.seek(0)
    crc = 0
    while left_bytes > 0 and (block := file.read(min(left_bytes, 1 << 20))):
        crc = zlib.crc32(block, crc)
        left_bytes -= len(block)
    return crc
