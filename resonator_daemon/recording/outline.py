"""Outline of a recording: where its parts of some seconds begin, without reading what they contain."""

import hashlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel

from resonator_daemon.recording.mcap_messages import MAX_CHUNK_BYTES, ChunkReader, declared_channels
from resonator_daemon.recording.reader import DAMAGE, MAX_RECORD_BYTES
from resonator_daemon.recording.repair import read_index

_MAGIC_BYTES: Final = 8
_HEAD: Final = struct.Struct("<BQQ")  # opcode, length, and of a chunk the log time of its first message
_RECORD_BYTES: Final = 9
_CHUNK_HEAD_BYTES: Final = 37  # of its record: times, size and check sum of what it contains
_CHUNKS_READ: Final = 64  # for the channels of a file without an index


class PartStart(NamedTuple):
    """First byte of a part, and UTC of its first message."""

    begin_bytes: int
    utc_ns: int


class Outline(NamedTuple):
    """Parts of a recording.

    Attributes
    ----------
    identity
        Hash up to the check sum of the first chunk of MCAP with messages: equal for copies of one recording, whatever
        their names, also if one is truncated, or the recording has grown since.
    size_bytes
        Of the file.
    starts
        Of its parts, in order; empty if the file has no messages.
    channels
        Topics by number of their channel, as far as the index or the first chunks have them.
    """

    identity: str
    size_bytes: int
    starts: tuple[PartStart, ...]
    channels: dict[int, str]


def read_outline(path: Path, part_s: float) -> Outline:
    """Read where the parts of a recording begin: with the first chunk of MCAP, then so many seconds apart."""
    with path.open("rb") as file:
        size_bytes = os.fstat(file.fileno()).st_size
        starts: list[PartStart] = []
        for start in _chunk_starts(file, size_bytes):
            if not starts or not 0 <= start.utc_ns - starts[-1].utc_ns < part_s * 1e9:  # the clock may be set back
                starts.append(start)
        first = file.read(starts[0].begin_bytes + _CHUNK_HEAD_BYTES) if starts else b""
        return Outline(hashlib.sha256(first).hexdigest()[:16], size_bytes, tuple(starts), _channels(file))


def _chunk_starts(file: IO[bytes], size_bytes: int) -> Iterator[PartStart]:
    """Give the beginning of each chunk, up to the end or to what is no record."""
    at = _MAGIC_BYTES
    while True:
        head = os.pread(file.fileno(), _HEAD.size, at)
        if len(head) < _HEAD.size:
            return
        opcode, length, utc_ns = _HEAD.unpack(head)
        end = at + _RECORD_BYTES + length
        if end > size_bytes or length > MAX_RECORD_BYTES:
            return
        if opcode == Opcode.CHUNK and length < MAX_CHUNK_BYTES and utc_ns:  # 0: it has no messages
            yield PartStart(at, utc_ns)
        at = end


def _channels(file: IO[bytes]) -> dict[int, str]:
    index = read_index(file)
    channels = {record.id: record.topic for record in index.records if isinstance(record, Channel)}
    if channels:
        return channels
    file.seek(0)
    records = ChunkReader(file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES).records
    try:
        for _, record in zip(range(_CHUNKS_READ), records, strict=False):
            channels |= declared_channels(record)
    except DAMAGE:
        pass  # those before it are all there is
    return channels
