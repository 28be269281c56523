import io
import struct
import tracemalloc

import lz4.frame
import pytest
from mcap.exceptions import McapError
from mcap.records import Chunk, Footer, Message, MessageIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from resonator_daemon.recording.mcap_messages import MAX_CHUNK_BYTES, ChunkReader, Logged, chunk_data, messages

TOPICS = ("wanted", "second")


def file_of(count, **options):
    """Write messages on three channels in turn, two of them wanted, over several chunks."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=512, **options)
    writer.start()
    channels = [writer.register_channel(topic, "", 0) for topic in ("wanted", "other", "second")]
    for number in range(count):
        writer.add_message(channels[number % 3], 10 * number + 1, bytes(number % 50), 10 * number, number)
    writer.finish()
    return file.getvalue()


def reader_of(content):
    return ChunkReader(io.BytesIO(content), emit_chunks=True, validate_crcs=True)


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
@pytest.mark.parametrize("use_chunking", [True, False])
def test_messages_are_those_that_a_reader_of_records_gives(compression, use_chunking):
    content = file_of(200, compression=compression, use_chunking=use_chunking)
    every = [r for r in StreamReader(io.BytesIO(content)).records if isinstance(r, Message)]
    assert len(every) == 200
    expected = [m for m in every if m.sequence % 3 != 1]
    told = list(messages(reader_of(content).records, TOPICS))
    assert told == [(TOPICS[m.sequence % 3 // 2], m.data, m.publish_time, m.log_time) for m in expected]
    assert {type(message) for message in told} == {Logged}


def test_indexes_are_passed_over_and_what_follows_them_is_read():
    content = file_of(200)
    assert any(isinstance(r, MessageIndex) for r in StreamReader(io.BytesIO(content), emit_chunks=True).records)
    records = list(reader_of(content).records)
    assert not any(isinstance(r, MessageIndex) for r in records)
    assert isinstance(records[-1], Footer)


def test_a_changed_byte_of_a_chunk_is_found_and_messages_before_it_are_given():
    content = bytearray(file_of(200, compression=CompressionType.NONE))
    second = content.index(struct.pack("<HIQQ", 1, 90, 901, 900))
    content[second + 23] ^= 1
    told: list[int] = []
    with pytest.raises((ValueError, McapError), match="crc"):
        told.extend(message.publish_ns // 10 for message in messages(reader_of(content).records, TOPICS))
    assert told == [n for n in range(told[-1] + 1) if n % 3 != 1]
    assert 0 < told[-1] < 90


@pytest.mark.parametrize("declared_bytes", [1000, MAX_CHUNK_BYTES, 8 * MAX_CHUNK_BYTES])
def test_a_chunk_that_expands_without_end_is_damage_and_takes_no_memory(declared_bytes):
    bomb = lz4.frame.compress(bytes(8 * MAX_CHUNK_BYTES))
    assert len(bomb) < MAX_CHUNK_BYTES // 10
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"a chunk (has|declares) \d+ bytes"):
            chunk_data(Chunk("lz4", bomb, 0, 0, 0, declared_bytes))
        assert tracemalloc.get_traced_memory()[1] < 3 * MAX_CHUNK_BYTES
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("compression", "data"), [("lz4", lz4.frame.compress(b"12345")), ("", b"12345")])
def test_a_chunk_has_the_size_that_it_says(compression, data):
    assert chunk_data(Chunk(compression, data, 0, 0, 0, 5)) == b"12345"
    for other_bytes in (4, 6):
        with pytest.raises(ValueError, match=f"declares {other_bytes} bytes"):
            chunk_data(Chunk(compression, data, 0, 0, 0, other_bytes))
