"""Outline of a recording: where its parts of some seconds begin, without reading what they contain."""

import hashlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel

from resonator_daemon.recording.mcap_messages import ChunkReader, declared_channels
from resonator_daemon.recording.reader import DAMAGE, MAX_RECORD_BYTES, TOPIC
from resonator_daemon.recording.repair import read_index

_MAGIC_BYTES: Final = 8
# Opcode and length; of a message index: channel, size of the entries, log time of the first one.
_HEAD: Final = struct.Struct("<BQHIQ")
_RECORD_BYTES: Final = 9
_CHUNK_HEAD_BYTES: Final = 37  # of its record: times, size and check sum of what it contains
_CHUNKS_READ: Final = 64  # for the channels of a file without an index


class PartStart(NamedTuple):
    """First byte of a part, and UTC of its first event."""

    begin_bytes: int
    utc_ns: int


class Outline(NamedTuple):
    """Parts of a recording.

    Attributes
    ----------
    identity
        Hash up to the check sum of the first chunk of MCAP with events: equal for copies of one recording, whatever
        their names, also if one is truncated, or the recording has grown since.
    size_bytes
        Of the file.
    starts
        Of its parts, in order; empty if the file has no events.
    channels
        Topics by number of their channel, as far as the index or the first chunks have them.
    """

    identity: str
    size_bytes: int
    starts: tuple[PartStart, ...]
    channels: dict[int, str]


def read_outline(path: Path, part_s: float) -> Outline:
    """Read where the parts of a recording begin: with the first chunk of MCAP, then so many seconds apart.

    Events on the link count. Messages that the daemon has published are of an earlier time than the events around them.
    """
    with path.open("rb") as file:
        size_bytes = os.fstat(file.fileno()).st_size
        channels = _channels(file)
        file.seek(0)
        starts: list[PartStart] = []
        for start in _chunk_starts(file, size_bytes, channels):
            if not starts or abs(start.utc_ns - starts[-1].utc_ns) >= part_s * 1e9:  # the clock may be set back
                starts.append(start)
        first = file.read(starts[0].begin_bytes + _CHUNK_HEAD_BYTES) if starts else b""
        return Outline(hashlib.sha256(first).hexdigest()[:16], size_bytes, tuple(starts), channels)


def _chunk_starts(file: IO[bytes], size_bytes: int, channels: dict[int, str]) -> Iterator[PartStart]:
    """Give the beginning of each chunk with events, up to the end or to what is no record."""
    at = _MAGIC_BYTES
    chunk_bytes = at
    while True:
        head = os.pread(file.fileno(), _HEAD.size, at)
        if len(head) < _HEAD.size:
            return
        opcode, length, channel, entries_bytes, utc_ns = _HEAD.unpack(head)
        end = at + _RECORD_BYTES + length
        if end > size_bytes or length > MAX_RECORD_BYTES:
            return
        if opcode == Opcode.CHUNK:
            chunk_bytes = at
        elif opcode == Opcode.MESSAGE_INDEX and entries_bytes and channels.get(channel) == TOPIC:  # of the chunk before
            yield PartStart(chunk_bytes, utc_ns)
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
