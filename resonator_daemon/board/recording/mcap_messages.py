"""Records and messages of an MCAP file in their order: each record is verified, and no length is trusted."""

import os
import re
import struct
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from io import BytesIO
from typing import IO, Any, Final, NamedTuple

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Header, McapRecord, Metadata
from mcap.stream_reader import CRCValidationError
from mcap.writer import MCAP0_MAGIC

_RECORD: Final = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE: Final = struct.Struct("<BQHIQQ")  # with channel, sequence, log time, publish time; its data follow
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)
_INDEX_ENTRY_BYTES: Final = 16

CHUNK_BYTES: Final = 256 << 10  # as written: about a millisecond to compress
MAX_CHUNK_BYTES: Final = 16 << 20  # as read
"""Bytes of a chunk's records, uncompressed. The last event or message of a chunk makes it longer than CHUNK_BYTES."""
MAX_RECORD_BYTES: Final = 64 << 20  # of MCAP

# Opcode and length of records that may follow damage: chunk, message index, attachment, metadata, end of the data.
_HEADS: Final = re.compile(rb"(?=[\x06\x07\x09\x0c\x0f].{3}[\x00-\x04]\0{4})", re.DOTALL)
_SEARCH_BYTES: Final = 1 << 20

_TIMES_BYTES: Final = 16  # of an attachment, before its name
_KINDS: Final[dict[int, Any]] = {Opcode.HEADER: Header, Opcode.METADATA: Metadata, Opcode.DATA_END: DataEnd}
_CRC: Final = struct.Struct("<I")
# What mcap, lz4 and `decode` raise about bytes that they cannot read.
_BAD_VALUES = (ValueError, LookupError, TypeError, ArithmeticError, struct.error)
READ_ERRORS = (McapError, RuntimeError, MemoryError, OSError, *_BAD_VALUES)


@dataclass
class DamagedAttachment(McapRecord):
    """Attachment that has a wrong checksum, or cannot be read.

    Parameters
    ----------
    name
        As in the file, where it may be damaged; a question mark if it cannot be read.
    """

    name: str


@dataclass
class IndexedMessages(McapRecord):
    """Number of messages of a channel in the preceding chunk, from the message index after it."""

    channel_id: int
    count: int


@dataclass
class Damage(McapRecord):
    """Bytes of a file without an intact record; `reason`: why no record could be read at `begin_bytes`."""

    begin_bytes: int
    end_bytes: int
    reason: Exception


class _Content(ReadDataStream):
    """Content of a record; a read beyond its end raises EndOfFile."""

    def read(self, length: int) -> bytes:
        data: bytes = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def read_records(file: IO[bytes], begin_bytes: int = 0, end_bytes: int | None = None) -> Iterator[McapRecord]:
    """Yield the records of a file up to the end of its data, and a `Damage` in place of bytes that are no record.

    After damage, reading continues at the next record whose checksum, if it has one, is right.

    Parameters
    ----------
    begin_bytes
        Position of a record; 0: the beginning of the file.
    end_bytes
        End of the data; None: the end of the file.
    """
    at = begin_bytes
    while True:
        try:
            file.seek(at)
            if not at and file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise McapError("not an MCAP file")
            record = _read_record(file)
        except READ_ERRORS as error:
            reason = error.with_traceback(None)  # a traceback would keep the content of the record
        else:
            at = file.tell()
            yield record
            if isinstance(record, DataEnd):
                return
            continue
        size_bytes = end_bytes or file.seek(0, os.SEEK_END)
        begin, at = at, _next_record(file, at + 1, size_bytes)
        yield Damage(begin, at, reason)
        if at >= size_bytes:
            return


def _read_record(file: IO[bytes]) -> McapRecord:
    """Read the record at the file's position; raises one of READ_ERRORS if there is none."""
    opcode, length = _RECORD.unpack(file.read(_RECORD.size))
    if length > MAX_RECORD_BYTES:
        raise ValueError(f"a record has {length} bytes, at most {MAX_RECORD_BYTES} are read")
    content = file.read(length)
    if len(content) < length:
        raise EndOfFile
    record = _parsed(opcode, content)
    if isinstance(record, DamagedAttachment):
        end = file.tell()
        _read_record(file)  # raises if the length is damaged
        file.seek(end)
    return record


def _parsed(opcode: int, content: bytes) -> McapRecord:
    stream = _Content(BytesIO(content))
    record: McapRecord
    match opcode:
        case Opcode.ATTACHMENT:
            return _read_attachment(content)
        case Opcode.MESSAGE_INDEX:  # its entries are for random access
            channel_id, entries_bytes = stream.read2(), stream.read4()
            stream.read(entries_bytes)
            record = IndexedMessages(channel_id, entries_bytes // _INDEX_ENTRY_BYTES)
        case Opcode.CHUNK:
            chunk = Chunk.read(stream)
            record = replace(chunk, compression="", data=_chunk_data(chunk))
        case Opcode.HEADER | Opcode.METADATA | Opcode.DATA_END:
            record = _KINDS[opcode].read(stream)
        case _:
            raise ValueError(f"no record of a recording has opcode {opcode}")
    if stream.count != len(content):
        raise ValueError(f"a record of {len(content)} bytes contains {stream.count}")
    return record


def _next_record(file: IO[bytes], at: int, end_bytes: int) -> int:
    """Return the position of the next intact record, or `end_bytes`."""
    while at < end_bytes:
        file.seek(at)
        for match in _HEADS.finditer(file.read(_SEARCH_BYTES + _RECORD.size)):
            with suppress(*READ_ERRORS):
                file.seek(at + match.start())
                _read_record(file)
                return at + match.start()
        at += _SEARCH_BYTES
    return end_bytes


def _read_attachment(content: bytes) -> Attachment | DamagedAttachment:
    """Read the content of an attachment's record.

    By the specification of MCAP, the CRC-32 covers all content before it; 0 means that there is none.
    """
    with suppress(*READ_ERRORS):
        (crc,) = _CRC.unpack(content[-_CRC.size :])
        if crc in (0, zlib.crc32(content[: -_CRC.size])):
            attachment: Attachment = Attachment.read(_Content(BytesIO(content)))
            return attachment
    name = "?"
    with suppress(*READ_ERRORS):
        name = _Content(BytesIO(content[_TIMES_BYTES:])).read_prefixed_string()
    return DamagedAttachment(name)


class Logged(NamedTuple):
    """Message with its topic, its data and both of its times."""

    topic: str
    data: bytes
    publish_ns: int
    log_ns: int


def messages(records: Iterator[McapRecord], topics: Collection[str], channels: Mapping[int, str]) -> Iterator[Logged]:
    """Yield the messages on these topics.

    Parameters
    ----------
    records
        Records of a file.
    channels
        Topics of the channels that records before these have declared.

    Raises
    ------
    ValueError
        A record exceeds its chunk.
    """
    of_channel = {number: topic for number, topic in channels.items() if topic in topics}
    for record in records:
        if isinstance(record, Chunk):
            yield from _of_chunk(record.data, topics, of_channel)


def _chunk_data(chunk: Chunk) -> bytes:
    """Return the records of a chunk, never more than MAX_CHUNK_BYTES of them.

    Raises
    ------
    ValueError, RuntimeError
        The compression is not lz4, the chunk is too large, or its size or checksum is wrong.
    """
    size_bytes = chunk.uncompressed_size
    if size_bytes > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk has {size_bytes} bytes, at most {MAX_CHUNK_BYTES} are read")
    if chunk.compression == "lz4":
        data: bytes = LZ4FrameDecompressor().decompress(chunk.data, max_length=size_bytes + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"a chunk is compressed by {chunk.compression!r}, recordings are by lz4")
    if len(data) != size_bytes:
        raise ValueError(f"a chunk declares {size_bytes} bytes and contains a different number")
    if chunk.uncompressed_crc and (crc := zlib.crc32(data)) != chunk.uncompressed_crc:
        raise CRCValidationError(chunk.uncompressed_crc, crc, chunk)
    return data


def _of_chunk(data: bytes, topics: Collection[str], of_channel: dict[int, str]) -> Iterator[Logged]:
    # For 2000 messages per second of recorded time: local variables, and tuples without a call of their class.
    new_tuple, message_bytes = tuple.__new__, _MESSAGE.size
    size_bytes = len(data)
    end = 0
    while end < size_bytes:
        begin = end
        opcode, length = _RECORD.unpack_from(data, begin)
        start = begin + _RECORD.size
        end = start + length
        if end > size_bytes:
            raise ValueError(f"a record ends {end - size_bytes} bytes behind its chunk")
        if opcode == _MESSAGE_OPCODE:
            _, _, channel_id, _, log_ns, publish_ns = _MESSAGE.unpack_from(data, begin)
            topic = of_channel.get(channel_id)
            if topic is not None:
                yield new_tuple(Logged, (topic, data[begin + message_bytes : end], publish_ns, log_ns))
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_Content(BytesIO(data[start:end])))
            if channel.topic in topics:
                of_channel[channel.id] = channel.topic
