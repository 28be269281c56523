import io
import tracemalloc

import lz4.frame
import pytest
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from resonator_daemon.board.recording.mcap_messages import MAX_CHUNK_BYTES, Damage, Logged, messages, read_records

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


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
def test_messages_are_those_that_a_reader_of_records_gives(compression):
    content = file_of(200, compression=compression)
    every = [r for r in StreamReader(io.BytesIO(content)).records if isinstance(r, Message)]
    assert len(every) == 200
    expected = [m for m in every if m.sequence % 3 != 1]
    found = list(messages(read_records(io.BytesIO(content)), TOPICS, {}))
    assert found == [(TOPICS[m.sequence % 3 // 2], m.data, m.publish_time, m.log_time) for m in expected]
    assert {type(message) for message in found} == {Logged}


def chunk_data(chunk):
    """Return the records of a chunk in a file."""
    builder = RecordBuilder()
    chunk.write(builder)
    record = next(read_records(io.BytesIO(MCAP0_MAGIC + builder.end())))
    if isinstance(record, Damage):
        raise record.reason
    return record.data


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
def test_a_chunk_has_the_size_that_it_declares(compression, data):
    assert chunk_data(Chunk(compression, data, 0, 0, 0, 5)) == b"12345"
    for other_bytes in (4, 6):
        with pytest.raises(ValueError, match=f"declares {other_bytes} bytes"):
            chunk_data(Chunk(compression, data, 0, 0, 0, other_bytes))
