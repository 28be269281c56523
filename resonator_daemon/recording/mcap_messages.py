"""Messages and attachments of an MCAP file in their order, without what reading by records would make of each."""

import struct
import zlib
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from typing import Final, NamedTuple

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message
from mcap.stream_reader import CRCValidationError, StreamReader

_RECORD: Final = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE: Final = struct.Struct("<BQHIQQ")  # with channel, sequence, log time, publish time; its data follow
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)

CHUNK_BYTES: Final = 256 << 10  # as written: about a millisecond to compress
MAX_CHUNK_BYTES: Final = 16 << 20  # as read
"""Of a chunk's records: those that are written have 256 KiB and what fills them, an event of 256 KiB or a message."""

_TIMES_BYTES: Final = 16
_CRC: Final = struct.Struct("<I")
_UNREADABLE: Final = (McapError, ValueError, OverflowError, MemoryError, struct.error)


@dataclass
class DamagedAttachment(McapRecord):
    """An attachment with a wrong check sum, or one that cannot be read.

    Parameters
    ----------
    name
        As it is in the file, which may be damaged, too; a question mark where it cannot be read.
    """

    name: str


def read_attachment(content: bytes) -> Attachment | DamagedAttachment:
    """Read the content of an attachment's record.

    As in the specification of MCAP the check sum, CRC-32, is of all content before it, and 0 means that there is none.
    """
    with suppress(*_UNREADABLE):
        (crc,) = _CRC.unpack(content[-_CRC.size :])
        if crc in (0, zlib.crc32(content[: -_CRC.size])):
            attachment: Attachment = Attachment.read(ReadDataStream(BytesIO(content)))
            return attachment
    return DamagedAttachment(_name(content))


def _name(content: bytes) -> str:
    name = "?"
    with suppress(*_UNREADABLE):
        name = ReadDataStream(BytesIO(content[_TIMES_BYTES:])).read_prefixed_string()
    return name


class Logged(NamedTuple):
    """A message: its topic, its data and both of its times."""

    topic: str
    data: bytes
    publish_ns: int
    log_ns: int


class ChunkReader(StreamReader):
    """Reads the records of a file but for message indexes; chunks as they are, attachments checked."""

    # Of no use to a reader of all in order, and two thirds of the time that reading takes. Should another version of
    # mcap have no such method, the indexes are parsed again.
    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        if opcode == Opcode.MESSAGE_INDEX:
            self._stream.read(length)
            return None
        if opcode == Opcode.ATTACHMENT:
            return read_attachment(self._stream.read(length))
        return super()._read_record(opcode, length)


def messages(records: Iterator[McapRecord], topics: Collection[str]) -> Iterator[Logged]:
    """Give the messages on these topics.

    Parameters
    ----------
    records
        Of a file, its chunks whole, as a ChunkReader gives them. What it raises about damage is passed on.

    Raises
    ------
    ValueError
        A chunk does not agree with its check sum or its records.
    """
    of_channel: dict[int, str] = {}
    for record in records:
        if isinstance(record, Chunk):
            yield from _of_chunk(record, topics, of_channel)
        elif isinstance(record, Channel):
            _note(record, topics, of_channel)
        elif isinstance(record, Message) and record.channel_id in of_channel:
            yield Logged(of_channel[record.channel_id], record.data, record.publish_time, record.log_time)


def declared_channels(record: McapRecord) -> dict[int, str]:
    """Return the topics by number of the channels that a record is, or a chunk contains; ValueError for damage."""
    if isinstance(record, Channel):
        return {record.id: record.topic}
    if not isinstance(record, Chunk):
        return {}
    channels: dict[int, str] = {}
    with suppress(EndOfFile):  # a chunk has no footer, for which the reader looks
        for inner in StreamReader(BytesIO(chunk_data(record)), skip_magic=True).records:
            if isinstance(inner, Channel):
                channels[inner.id] = inner.topic
    return channels


def chunk_data(chunk: Chunk) -> bytes:
    """Return the records of a chunk, never more than MAX_CHUNK_BYTES of them.

    Raises
    ------
    ValueError, RuntimeError
        It is compressed otherwise than recordings are, is larger, or does not agree with its check sum or size.
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


def _of_chunk(chunk: Chunk, topics: Collection[str], of_channel: dict[int, str]) -> Iterator[Logged]:
    # Two thousand messages a second of recorded time: locals, and tuples are made without the detour of their class.
    new_tuple, message_bytes = tuple.__new__, _MESSAGE.size
    data = chunk_data(chunk)
    size_bytes = len(data)
    end = 0
    while end < size_bytes:
        begin = end
        opcode, length = _RECORD.unpack_from(data, begin)
        start = begin + _RECORD.size
        end = start + length
        if end > size_bytes:
            raise ValueError(f"a record of a chunk ends {end - size_bytes} bytes behind it")
        if opcode == _MESSAGE_OPCODE:
            _, _, channel_id, _, log_ns, publish_ns = _MESSAGE.unpack_from(data, begin)
            topic = of_channel.get(channel_id)
            if topic is not None:
                yield new_tuple(Logged, (topic, data[begin + message_bytes : end], publish_ns, log_ns))
        elif opcode == Opcode.CHANNEL:
            _note(Channel.read(ReadDataStream(BytesIO(data[start:end]))), topics, of_channel)


def _note(channel: Channel, topics: Collection[str], of_channel: dict[int, str]) -> None:
    if channel.topic in topics:
        of_channel[channel.id] = channel.topic
