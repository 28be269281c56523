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

_HEADER = struct.Struct("<2sBBIQIHH")
_CRC = struct.Struct("<I")
_CHECKED_HEADER_BYTES = _HEADER.size - 2  # all but header_check itself

PACKET_OVERHEAD_BYTES = _HEADER.size + _CRC.size


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

    GARBAGE = "garbage"  # no sync word where a packet had to begin
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


@dataclass(slots=True)
class ByteCounts:
    """Where the bytes went; `received` equals the sum of all others and of those still waiting."""

    received: int = 0
    accepted: int = 0
    other_version: int = 0
    own_direction: int = 0
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
    head = _HEADER.pack(
        SYNC, major, message_type, sequence & 0xFFFFFFFF, board_ticks & 0xFFFFFFFFFFFFFFFF, boot_id, len(payload), 0
    )[:_CHECKED_HEADER_BYTES]
    body = b"".join((head, crc_hqx(head, 0xFFFF).to_bytes(2, "little"), payload))
    return body + _CRC.pack(crc32(body))


class PacketDecoder:
    """Finds packets in a stream of bytes that may be cut anywhere and damaged anywhere.

    Parameters
    ----------
    from_board
        Which direction this end expects; sound packets of the other direction are an echo, counted and dropped.
    """

    def __init__(self, *, from_board: bool) -> None:
        self._direction = FROM_BOARD if from_board else 0
        self._tail = b""
        self._discarding: Defect | None = None
        self._discarded_bytes = 0
        self.counts = ByteCounts()

    @property
    def waiting_bytes(self) -> int:
        """Bytes of a packet that has begun and is not complete."""
        return len(self._tail)

    def feed(self, data: bytes) -> list[Packet | Damage | ForeignVersion]:
        """Take received bytes; return the packets they complete, each after the damage that came before it."""
        counts = self.counts
        counts.received += len(data)
        buffer = self._tail + data
        view = memoryview(buffer)
        end = len(buffer)
        position = 0
        found: list[Packet | Damage | ForeignVersion] = []
        while True:
            start = buffer.find(SYNC, position)
            if start < 0:
                start = end - buffer.endswith(SYNC[:1], position)
                self._discard(start - position, Defect.GARBAGE)
                position = start
                break
            self._discard(start - position, Defect.GARBAGE)
            position = start
            if end - position < _HEADER.size:
                break
            header = _HEADER.unpack_from(buffer, position)
            _, major, message_type, sequence, board_ticks, boot_id, length, header_check = header
            if crc_hqx(view[position : position + _CHECKED_HEADER_BYTES], 0xFFFF) != header_check:
                position += self._discard(len(SYNC), Defect.BAD_HEADER)
                continue
            if length > MAX_PAYLOAD_BYTES:
                position += self._discard(len(SYNC), Defect.BAD_LENGTH)
                continue
            crc_at = position + _HEADER.size + length
            if end < crc_at + _CRC.size:
                break
            if crc32(view[position:crc_at]) != _CRC.unpack_from(buffer, crc_at)[0]:
                position += self._discard(len(SYNC), Defect.BAD_CRC)
                continue
            if self._discarding is not None:
                found.append(Damage(self._discarding, self._discarded_bytes))
                self._discarding, self._discarded_bytes = None, 0
            size_bytes = crc_at + _CRC.size - position
            if major != PROTOCOL_MAJOR:
                counts.other_version += size_bytes
                found.append(ForeignVersion(major))
            elif message_type & FROM_BOARD != self._direction:
                counts.own_direction += size_bytes
            else:
                counts.accepted += size_bytes
                payload = bytes(view[position + _HEADER.size : crc_at])
                found.append(Packet(message_type, sequence, board_ticks, boot_id, payload))
            position += size_bytes
        self._tail = buffer[position:]
        return found

    def _discard(self, size_bytes: int, defect: Defect) -> int:
        if size_bytes:
            self._discarding = self._discarding or defect
            self._discarded_bytes += size_bytes
            self.counts.discarded += size_bytes
        return size_bytes
