"""Packets: how messages are delimited, checked and found again after damage (PROTOCOL.md, section 1)."""

import struct
from binascii import crc_hqx
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple
from zlib import crc32

from firmware_protocol.layouts import FROM_BOARD, PROTOCOL_MAJOR

SYNC = b"\xa5\x5a"
MAX_PAYLOAD_BYTES = 8944  # so that a packet fits one datagram in a jumbo Ethernet frame

_HEADER = struct.Struct("<HBBIQIHH")
_CHECKED_HEADER = struct.Struct("<HBBIQIH")  # all but header_check
_HEADER_CHECK = struct.Struct("<H")
_HEADER_BYTES = _HEADER.size
_CRC = struct.Struct("<I")
_CHECKED_HEADER_BYTES = _CHECKED_HEADER.size
_SYNC_NUMBER = int.from_bytes(SYNC, "little")
_SOUND = 0x2144DF1C  # CRC-32 of anything followed by its own CRC-32

PACKET_OVERHEAD_BYTES = _HEADER_BYTES + _CRC.size
MAX_PACKET_BYTES = PACKET_OVERHEAD_BYTES + MAX_PAYLOAD_BYTES


class Packet(NamedTuple):
    """One packet that passed both checks."""

    type: int
    sequence: int
    board_ticks: int
    boot_id: int
    payload: bytes

    @property
    def size_bytes(self) -> int:
        return PACKET_OVERHEAD_BYTES + len(self.payload)


class Defect(Enum):
    """Why a run of bytes was discarded."""

    GARBAGE = "garbage"  # no sync word where a packet had to begin, or a packet that was given up
    BAD_HEADER = "bad_header"
    BAD_LENGTH = "bad_length"
    BAD_CRC = "bad_crc"


class Damage(NamedTuple):
    """A run of discarded bytes, reported with the packet that ended it."""

    defect: Defect
    size_bytes: int


class ForeignVersion(NamedTuple):
    """A sound packet of another major version, not interpreted."""

    major: int
    type: int
    sequence: int


@dataclass(slots=True)
class ByteCounts:
    """Where the bytes went; `received` equals the sum of all others and of those still waiting."""

    received: int = 0
    accepted: int = 0
    other_version: int = 0
    echo: int = 0
    discarded: int = 0


def encode_packet(
    message_type: int,
    sequence: int,
    payload: bytes = b"",
    *,
    board_ticks: int = 0,
    boot_id: int = 0,
    major: int = PROTOCOL_MAJOR,
) -> bytes:
    """Return the bytes of one packet.

    Raises
    ------
    ValueError
        If the payload is longer than a packet may carry.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload must have at most {MAX_PAYLOAD_BYTES} bytes, got {len(payload)}")
    checked = encode_header(message_type, sequence, len(payload), board_ticks, boot_id, major) + payload
    return checked + packet_check(crc32(checked))


def encode_header(
    message_type: int,
    sequence: int,
    payload_bytes: int,
    board_ticks: int,
    boot_id: int,
    major: int = PROTOCOL_MAJOR,
) -> bytes:
    """Return what precedes the payload of a packet."""
    head = _CHECKED_HEADER.pack(
        _SYNC_NUMBER,
        major,
        message_type,
        sequence & 0xFFFFFFFF,
        board_ticks & 0xFFFFFFFFFFFFFFFF,
        boot_id,
        payload_bytes,
    )
    return head + _HEADER_CHECK.pack(crc_hqx(head, 0xFFFF))


packet_check = _CRC.pack  # what follows the payload, of the CRC-32 of all before


class PacketDecoder:
    """Finds packets in a stream of bytes that may be cut anywhere and damaged anywhere.

    Parameters
    ----------
    from_board
        Which direction this end expects; sound packets of the other direction are an echo, counted and dropped.
    max_packet_bytes
        What this end has room for; a header that promises more is damage.
    """

    def __init__(self, *, from_board: bool, max_packet_bytes: int = MAX_PACKET_BYTES) -> None:
        self._direction = FROM_BOARD if from_board else 0
        self._max_packet_bytes = max_packet_bytes
        self._waiting: list[bytes] = []
        self._wanted_bytes = 0  # with fewer than these nothing can be decoded
        self._discarding: Defect | None = None
        self._discarded_bytes = 0
        self.counts = ByteCounts()
        self.waiting_bytes = 0  # of a packet that has begun and is not complete

    def abandon(self) -> None:
        """Give up the packet that has begun: its rest will not come. Its bytes count as discarded."""
        self._discard(self.waiting_bytes, Defect.GARBAGE)
        self._waiting = []
        self.waiting_bytes = self._wanted_bytes = 0

    def feed(self, data: bytes) -> list[Packet | Damage | ForeignVersion]:
        """Decode received bytes; return the packets they complete, each after the damage before it."""
        self.counts.received += len(data)
        self.waiting_bytes += len(data)
        if self.waiting_bytes < self._wanted_bytes:
            if data:
                self._waiting.append(data)  # joined when it pays: a packet in many pieces is copied once
            return []
        return self._search(b"".join((*self._waiting, data)) if self._waiting else data)

    def _search(self, buffer: bytes) -> list[Packet | Damage | ForeignVersion]:
        # The loop runs once a packet at megabytes a second: locals, and one slice for each check.
        unpack_header, new_tuple, max_packet_bytes = _HEADER.unpack_from, tuple.__new__, self._max_packet_bytes
        direction = self._direction
        found: list[Packet | Damage | ForeignVersion] = []
        accepted_bytes = 0
        position, end, view = 0, len(buffer), memoryview(buffer)
        while True:
            if position == end:
                wanted_bytes = 0
                break
            if end - position < _HEADER_BYTES:
                start = self._next_start(buffer, position)
                if start != position:
                    position = start
                    continue
                wanted_bytes = _HEADER_BYTES if end - position >= len(SYNC) else (end - position) * len(SYNC)
                break
            sync, major, message_type, sequence, board_ticks, boot_id, length, check = unpack_header(buffer, position)
            if sync != _SYNC_NUMBER:
                position = self._next_start(buffer, position)
                continue
            if crc_hqx(buffer[position : position + _CHECKED_HEADER_BYTES], 0xFFFF) != check:
                position += self._discard(len(SYNC), Defect.BAD_HEADER)
                continue
            size_bytes = length + PACKET_OVERHEAD_BYTES
            if size_bytes > max_packet_bytes:
                position += self._discard(len(SYNC), Defect.BAD_LENGTH)
                continue
            after = position + size_bytes
            if after > end:
                wanted_bytes = size_bytes
                break
            if crc32(view[position:after]) != _SOUND:
                position += self._discard(len(SYNC), Defect.BAD_CRC)
                continue
            if self._discarding is not None:
                found.append(Damage(self._discarding, self._discarded_bytes))
                self._discarding, self._discarded_bytes = None, 0
            if major != PROTOCOL_MAJOR:
                self.counts.other_version += size_bytes
                found.append(ForeignVersion(major, message_type, sequence))
            elif message_type & FROM_BOARD != direction:
                self.counts.echo += size_bytes
            else:
                accepted_bytes += size_bytes
                payload = buffer[position + _HEADER_BYTES : after - _CRC.size]
                found.append(new_tuple(Packet, (message_type, sequence, board_ticks, boot_id, payload)))
            position = after
        self.counts.accepted += accepted_bytes
        self._waiting = [buffer[position:]] if position < end else []
        self.waiting_bytes, self._wanted_bytes = end - position, wanted_bytes
        return found

    def _next_start(self, buffer: bytes, position: int) -> int:
        """Discard what precedes the next sync word, or the half of one at the end; return where that is."""
        start = buffer.find(SYNC, position)
        if start < 0:
            start = len(buffer) - buffer.endswith(SYNC[:1], position)
        self._discard(start - position, Defect.GARBAGE)
        return start

    def _discard(self, size_bytes: int, defect: Defect) -> int:
        if size_bytes:
            self._discarding = self._discarding or defect
            self._discarded_bytes += size_bytes
            self.counts.discarded += size_bytes
        return size_bytes
