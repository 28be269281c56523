"""Messages of an MCAP file in their order, without what reading it record by record would make of each."""

import struct
from collections.abc import Collection, Iterator
from io import BytesIO
from typing import Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, get_chunk_data_stream

_RECORD: Final = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; its data follow


class ChunkReader(StreamReader):
    """Reads the records of a file but for message indexes, and chunks as they are."""

    # Of no use to whoever reads all in order, and two thirds of the time that reading takes. Should another version of
    # mcap have no such method, the indexes are parsed again.
    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        if opcode == Opcode.MESSAGE_INDEX:
            self._stream.read(length)
            return None
        return super()._read_record(opcode, length)


def messages(records: Iterator[McapRecord], topics: Collection[str]) -> Iterator[tuple[str, Message]]:
    """Give the messages on these topics, each with its topic.

    Parameters
    ----------
    records
        Of a file, its chunks whole, as a ChunkReader gives them. What it raises about damage is passed on.

    Raises
    ------
    ValueError
        A chunk is not what its check sum or its records say.
    """
    of_channel: dict[int, str] = {}
    for record in records:
        if isinstance(record, Chunk):
            yield from _of_chunk(record, topics, of_channel)
        elif isinstance(record, Channel):
            _note(record, topics, of_channel)
        elif isinstance(record, Message) and record.channel_id in of_channel:
            yield of_channel[record.channel_id], record


def _of_chunk(chunk: Chunk, topics: Collection[str], of_channel: dict[int, str]) -> Iterator[tuple[str, Message]]:
    stream, size_bytes = get_chunk_data_stream(chunk, validate_crc=True)
    data = stream.read(size_bytes)
    end = 0
    while end < size_bytes:
        opcode, length = _RECORD.unpack_from(data, end)
        start = end + _RECORD.size
        end = start + length
        if end > size_bytes:
            raise ValueError(f"a record of a chunk ends {end - size_bytes} bytes behind it")
        if opcode == Opcode.MESSAGE:
            channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(data, start)
            topic = of_channel.get(channel_id)
            if topic is not None:
                yield topic, Message(channel_id, log_ns, data[start + _MESSAGE.size : end], publish_ns, sequence)
        elif opcode == Opcode.CHANNEL:
            _note(Channel.read(ReadDataStream(BytesIO(data[start:end]))), topics, of_channel)


def _note(channel: Channel, topics: Collection[str], of_channel: dict[int, str]) -> None:
    if channel.topic in topics:
        of_channel[channel.id] = channel.topic
