"""Packets and fields put together from PROTOCOL.md alone, with checks computed bit by bit."""

from typing import Any

Case = dict[str, Any]


def crc16(data: bytes) -> int:
    register = 0xFFFF
    for byte in data:
        register ^= byte << 8
        for _ in range(8):
            register = (register << 1 ^ (0x1021 if register & 0x8000 else 0)) & 0xFFFF
    return register


def crc32(data: bytes) -> int:
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xEDB88320 if register & 1 else 0)
    return register ^ 0xFFFFFFFF


def packet(
    message_type: int,
    sequence: int,
    payload: bytes = b"",
    *,
    ticks: int = 0,
    boot_id: int = 0,
    major: int = 1,
    length: int | None = None,
) -> bytes:
    head = b"\xa5\x5a" + bytes((major, message_type)) + sequence.to_bytes(4, "little")
    head += ticks.to_bytes(8, "little") + boot_id.to_bytes(4, "little")
    head += (len(payload) if length is None else length).to_bytes(2, "little")
    body = head + crc16(head).to_bytes(2, "little") + payload
    return body + crc32(body).to_bytes(4, "little")


def number(tag: int, value: int) -> bytes:
    raw = value.to_bytes(max(1, (value.bit_length() + 7) // 8), "little")
    return bytes((tag, len(raw))) + raw


def text(tag: int, value: str) -> bytes:
    return bytes((tag, len(value.encode()))) + value.encode()


IDENTIFY, DESCRIBE, CONFIGURE, START, STOP, PING, LOCATE = range(1, 8)
REFUSED, LOG, STATUS, FRAME = 0x9F, 0x93, 0x92, 0x90
ONE, TWO = packet(IDENTIFY, 1), packet(DESCRIBE, 2)
PONG_ME = packet(PING, 9, b"12345678")


def flipped(data: bytes, position: int) -> bytes:
    return data[:position] + bytes((data[position] ^ 0x10,)) + data[position + 1 :]
