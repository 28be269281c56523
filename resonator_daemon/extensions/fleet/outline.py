"""Outline of a recording: where its parts of some seconds begin, without reading what they contain."""

import hashlib
import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import IO, Final, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Metadata

from resonator_daemon.board.recording.mcap_messages import MAX_RECORD_BYTES, READ_ERRORS, read_records
from resonator_daemon.board.recording.reader import CHANNEL, TOPIC, WIRE_CHANNEL, FilePath, open_file
from resonator_daemon.board.recording.repair import read_index

_MAGIC_BYTES: Final = 8
# Opcode and length; of a message index: channel, size of the entries, log time of the first one.
_HEAD: Final = struct.Struct("<BQHIQ")
_RECORD_BYTES: Final = 9
_CHUNK_HEAD_BYTES: Final = 37  # of its record: times, size and checksum of what it contains
_RECORDS_READ: Final = 64  # for the channels of a file without an index


class PartStart(NamedTuple):
    """First byte of a part, and UTC of its first event."""

    begin_bytes: int
    utc_ns: int


class Outline(NamedTuple):
    """Parts of a recording.

    Attributes
    ----------
    identity
        Hash up to the checksum of the first chunk of MCAP with events: equal for copies of one recording, whatever
        their names, also if one is truncated, or the recording has grown since.
    size_bytes, changed_ns
        Of the file; UTC of its last change.
    starts
        Of its parts, in order; empty if the file has no events.
    channels
        Topics by number of their channel, as far as the index or the first chunks have them.
    """

    identity: str
    size_bytes: int
    changed_ns: int
    starts: tuple[PartStart, ...]
    channels: dict[int, str]


def read_outline(path: FilePath, part_s: float) -> Outline:
    """Read where the parts of a recording begin: with the first chunk of MCAP, then so many seconds apart.

    Events on the link count. Messages that the daemon has published are of an earlier time than the events around them.
    """
    with open_file(path) as file:
        status = os.fstat(file.fileno())
        channels = _channels(file)
        file.seek(0)
        starts: list[PartStart] = []
        for start in _chunk_starts(file, status.st_size, channels):
            if not starts or abs(start.utc_ns - starts[-1].utc_ns) >= part_s * 1e9:  # the clock may be set back
                starts.append(start)
        first = file.read(starts[0].begin_bytes + _CHUNK_HEAD_BYTES) if starts else b""
        identity = hashlib.sha256(first).hexdigest()[:16]
        return Outline(identity, status.st_size, status.st_ctime_ns, tuple(starts), channels)


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
    channels = {channel.id: channel.topic for channel in read_index(file).channels}
    if channels:
        return channels
    channels[WIRE_CHANNEL] = TOPIC
    for record in islice(read_records(file), _RECORDS_READ):
        if isinstance(record, Metadata) and record.name == CHANNEL:
            with suppress(*READ_ERRORS):
                channels[int(record.metadata["id"])] = record.metadata["topic"]
    return channels
