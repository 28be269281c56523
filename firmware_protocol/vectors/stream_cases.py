"""Streams, and what a receiver finds in them."""

from typing import Any

from firmware_protocol.vectors.wire import DESCRIBE, IDENTIFY, ONE, PING, PONG_ME, TWO, Case, flipped, packet


def found(
    message_type: int, sequence: int, payload: bytes = b"", *, ticks: int = 0, boot_id: int = 0
) -> dict[str, Any]:
    return {
        "event": "packet",
        "type": message_type,
        "sequence": sequence,
        "board_ticks": ticks,
        "boot_id": boot_id,
        "payload": payload.hex(),
    }


def damage(defect: str, size_bytes: int) -> dict[str, Any]:
    return {"event": "damage", "defect": defect, "size_bytes": size_bytes}


def foreign(major: int, message_type: int, sequence: int) -> dict[str, Any]:
    return {"event": "foreign_version", "major": major, "type": message_type, "sequence": sequence}


def stream(
    name: str,
    data: bytes,
    events: list[dict[str, Any]],
    *,
    from_board: bool = False,
    max_packet_bytes: int = 64,
    waiting: int = 0,
    echo: int = 0,
    other_version: int = 0,
) -> Case:
    accepted = sum(28 + len(event["payload"]) // 2 for event in events if event["event"] == "packet")
    counts = {
        "received": len(data),
        "accepted": accepted,
        "other_version": other_version,
        "echo": echo,
        "discarded": len(data) - accepted - other_version - echo - waiting,
        "waiting": waiting,
    }
    return {
        "name": name,
        "from_board": from_board,
        "max_packet_bytes": max_packet_bytes,
        "stream": data.hex(),
        "events": events,
        "counts": counts,
    }


def streams() -> list[Case]:
    first, second = found(IDENTIFY, 1), found(DESCRIBE, 2)
    within = packet(PING, 3, ONE[:26])
    outer = flipped(packet(PING, 4, ONE), 53)  # a bit of its own crc
    largest = 2**64 - 1
    return [
        stream("nothing", b"", []),
        stream("one request", ONE, [first]),
        stream("three in a row", ONE + TWO + PONG_ME, [first, second, found(PING, 9, b"12345678")]),
        stream("an unknown type is a packet all the same", packet(0x7F, 5), [found(0x7F, 5)]),
        stream(
            "largest numbers",
            packet(0x7F, 2**32 - 1, ticks=largest, boot_id=2**32 - 1),
            [found(0x7F, 2**32 - 1, ticks=largest, boot_id=2**32 - 1)],
        ),
        stream("garbage before a packet", b"hello" + ONE, [damage("garbage", 5), first]),
        stream("garbage behind a packet is not told yet", ONE + b"hello", [first]),
        stream("half a sync word waits", ONE + b"\xa5", [first], waiting=1),
        stream("half a sync word, then another byte", b"\xa5\x00" + ONE, [damage("garbage", 2), first]),
        stream("first sync byte twice", b"\xa5" + ONE, [damage("garbage", 1), first]),
        stream("sync word twice", b"\xa5\x5a" + ONE, [damage("bad_header", 2), first]),
        stream("a packet without its last byte waits", ONE[:-1], [], waiting=27),
        stream("damaged header", flipped(ONE, 4) + TWO, [damage("bad_header", 28), second]),
        stream("damaged header_check", flipped(ONE, 22) + TWO, [damage("bad_header", 28), second]),
        stream("damaged payload", flipped(PONG_ME, 24) + TWO, [damage("bad_crc", 36), second]),
        stream("damaged crc", flipped(ONE, 27) + TWO, [damage("bad_crc", 28), second]),
        stream("damaged sync word", flipped(ONE, 1) + TWO, [damage("garbage", 28), second]),
        stream("length beyond every limit", packet(PING, 3, length=60000) + TWO, [damage("bad_length", 28), second]),
        stream("longest packet of this receiver", packet(PING, 3, bytes(36)), [found(PING, 3, bytes(36))]),
        stream(
            "a byte too long for this receiver", packet(PING, 3, bytes(37)) + TWO, [damage("bad_length", 65), second]
        ),
        stream(
            "two damaged packets are one run",
            flipped(ONE, 27) + b"x" + flipped(TWO, 4) + ONE,
            [damage("bad_crc", 57), first],
        ),
        stream("cut in its header", ONE[:20] + TWO, [damage("bad_header", 20), second]),
        stream("cut in its payload", PONG_ME[:30] + TWO, [damage("bad_crc", 30), second]),
        stream(
            "begun, then begun again, then begun again", ONE[:10] + ONE[:25] + TWO, [damage("bad_header", 35), second]
        ),
        stream("a byte lost", PONG_ME[:28] + PONG_ME[29:] + TWO, [damage("bad_crc", 35), second]),
        stream("a byte too many", PONG_ME[:28] + b"x" + PONG_ME[28:] + TWO, [damage("bad_crc", 37), second]),
        stream("a start inside a sound payload is nothing", within, [found(PING, 3, ONE[:26])]),
        stream(
            "a sound packet inside a damaged one is found",
            outer + TWO,
            [damage("bad_crc", 24), first, damage("garbage", 4), second],
        ),
        stream(
            "another version", packet(IDENTIFY, 7, b"new", major=2) + ONE, [foreign(2, 1, 7), first], other_version=31
        ),
        stream("version 0", packet(IDENTIFY, 7, major=0), [foreign(0, 1, 7)], other_version=28),
        stream(
            "another version from its own side",
            packet(0x81, 7, major=2),
            [foreign(2, 0x81, 7)],
            other_version=28,
        ),
        stream(
            "damage before another version",
            b"?" + packet(PING, 8, major=9),
            [damage("garbage", 1), foreign(9, 6, 8)],
            other_version=28,
        ),
        stream("echo", packet(0x86, 3, b"abcdefgh") + ONE, [first], echo=36),
        stream("damage before an echo", b"?!" + packet(0x86, 3), [damage("garbage", 2)], echo=28),
        stream(
            "a host hears a board",
            packet(0x86, 9, b"12345678", ticks=1000, boot_id=77) + ONE,
            [found(0x86, 9, b"12345678", ticks=1000, boot_id=77)],
            from_board=True,
            max_packet_bytes=8972,
            echo=28,
        ),
    ]
