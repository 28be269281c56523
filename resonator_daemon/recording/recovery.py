"""What can be read of a recording that was cut off or damaged, and where what cannot was."""

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from typing import IO, Final, NamedTuple, Self

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, MessageIndex, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from resonator_daemon.recording.mcap_attachments import read_attachment
from resonator_daemon.recording.mcap_messages import MAX_CHUNK_BYTES, chunk_data
from resonator_daemon.recording.reader import DAMAGE, MAX_RECORD_BYTES

_FOOTER: Final = struct.Struct("<BQQQI8s")  # opcode, length, where summary and its offsets begin, crc, magic
_CRC_AND_MAGIC_BYTES: Final = 12  # what the summary's check sum leaves out


class DamagedRange(NamedTuple):
    """Damaged part of a file, a chunk or a message; `messages` by channel, from the index behind a chunk."""

    size_bytes: int
    messages: dict[int, int]

    def joined(self, other: Self) -> "DamagedRange":
        """Return both as one."""
        channels = self.messages.keys() | other.messages.keys()
        messages = {channel: self.messages.get(channel, 0) + other.messages.get(channel, 0) for channel in channels}
        return DamagedRange(self.size_bytes + other.size_bytes, messages)


def known_channels(file: IO[bytes]) -> list[Schema | Channel]:
    """Return schemas and channels of the index at the end, where its check sum is right; the file is at its beginning.

    A damaged chunk may have held them.
    """
    known: list[Schema | Channel] = []
    with suppress(*DAMAGE):
        end = file.seek(-_FOOTER.size, os.SEEK_END)
        footer = file.read(_FOOTER.size)
        opcode, _, begin, _, crc, _ = _FOOTER.unpack(footer)
        size_bytes = end - begin
        if opcode == Opcode.FOOTER and begin and crc and 0 < size_bytes <= MAX_RECORD_BYTES:
            file.seek(begin)
            summary = file.read(size_bytes)
            if zlib.crc32(footer[:-_CRC_AND_MAGIC_BYTES], zlib.crc32(summary)) == crc:
                reader = StreamReader(BytesIO(summary + footer), skip_magic=True)
                known = [record for record in reader.records if isinstance(record, Schema | Channel)]
    file.seek(0)
    return known


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
                hole = DamagedRange(min(record.uncompressed_size, MAX_CHUNK_BYTES), {})
            else:
                yield from inner
        if hole is not None:
            yield hole

    def _outer(self) -> Iterator[McapRecord]:
        reader = _BoundedReader(self._file, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES)
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
