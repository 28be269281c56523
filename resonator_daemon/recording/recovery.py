"""What can be read of a recording that was cut off or damaged, and where what cannot was."""

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from typing import IO, Final, NamedTuple, Self

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, MessageIndex, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from resonator_daemon.recording.mcap_attachments import read_attachment
from resonator_daemon.recording.mcap_messages import MAX_CHUNK_BYTES, chunk_data
from resonator_daemon.recording.reader import DAMAGE, MAX_RECORD_BYTES

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
