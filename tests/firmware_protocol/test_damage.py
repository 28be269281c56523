"""Two hundred thousand damaged packets: none is accepted, and each costs itself alone."""

import random
from collections.abc import Callable

import pytest
from protocol_sessions import check_accounts

from firmware_protocol import packets
from firmware_protocol.packets import SYNC, Damage, Packet, PacketDecoder, encode_packet

FRAME_BYTES = 204
BATCH = 1000
Corruption = Callable[[int, random.Random], bytes]


def frames(rng: random.Random) -> list[bytes]:
    """Return frames of which one in eight has a payload full of sync words, so that false starts happen."""
    payloads = (
        b"".join(rng.choice([SYNC, SYNC + b"\x01\x90", rng.randbytes(4)]) for _ in range(90))[:176]
        if number % 8 == 1
        else rng.randbytes(176)
        for number in range(256)
    )
    return [encode_packet(0x90, n, payload, board_ticks=n << 20, boot_id=7) for n, payload in enumerate(payloads)]


RNG = random.Random(1)
FRAMES = frames(RNG)
NUMBERS = [int.from_bytes(frame, "little") for frame in FRAMES]
SOUND = [encode_packet(0x92, number, b"sound", boot_id=7) for number in range(BATCH)]
SENT = [Packet(0x92, number, 0, 7, b"sound") for number in range(BATCH)]


def flipped(index: int, mask: int) -> bytes:
    return (NUMBERS[index] ^ mask).to_bytes(FRAME_BYTES, "little")


def one_bit(index: int, rng: random.Random) -> bytes:
    return flipped(index, 1 << int(rng.random() * 8 * FRAME_BYTES))


def two_bits(index: int, rng: random.Random) -> bytes:
    first = int(rng.random() * 8 * FRAME_BYTES)
    second = (first + 1 + int(rng.random() * (8 * FRAME_BYTES - 1))) % (8 * FRAME_BYTES)
    return flipped(index, 1 << first | 1 << second)


def burst(index: int, rng: random.Random) -> bytes:
    bits = 3 + int(rng.random() * 14)  # up to 16, the first and the last of them flipped
    mask = rng.getrandbits(bits) | 1 | 1 << bits - 1
    return flipped(index, mask << int(rng.random() * (8 * FRAME_BYTES - bits + 1)))


def truncated(index: int, rng: random.Random) -> bytes:
    return FRAMES[index][: 1 + int(rng.random() * (FRAME_BYTES - 1))]


def spliced(index: int, rng: random.Random) -> bytes:
    """Return the beginning of one frame and the end of another, as when a piece of the stream is lost."""
    other = FRAMES[(index + 1 + int(rng.random() * 255)) % 256]
    start = 1 + int(rng.random() * (FRAME_BYTES - 1))
    raw = FRAMES[index][:start] + other[1 + int(rng.random() * (FRAME_BYTES - 1)) :]
    return raw if other not in raw else truncated(index, rng)  # payload may end as the other begins: it is whole then


def batch(corrupt: Corruption, rng: random.Random) -> tuple[bytes, int]:
    """Return damaged frames, a sound packet behind each, and how many of them are damaged indeed."""
    pieces, damaged = [], 0
    for sound in SOUND:
        index = int(rng.random() * 256)
        raw = corrupt(index, rng)
        if (raw + sound)[:FRAME_BYTES] != FRAMES[index]:  # what is missing may be what follows, by chance
            pieces.append(raw)
            damaged += 1
        pieces.append(sound)
    return b"".join(pieces), damaged


@pytest.mark.parametrize("corrupt", [one_bit, two_bits, burst, truncated, spliced])
def test_no_damaged_packet_is_accepted_and_the_next_one_is_found(corrupt: Corruption) -> None:
    rng = random.Random(2)
    damaged_in_all = 0
    for _ in range(41):
        decoder = PacketDecoder(from_board=True)
        stream, damaged = batch(corrupt, rng)
        found = decoder.feed(stream)
        found += decoder.feed(bytes(2 * FRAME_BYTES))  # more than a frame that was cut off can still promise
        assert [item for item in found if type(item) is Packet] == SENT
        assert len(found) == BATCH + damaged  # one report of damage for each
        check_accounts(decoder)
        damaged_in_all += damaged
    assert damaged_in_all >= 40_000


def test_packets_behind_a_promise_that_is_not_kept_are_late_and_not_lost() -> None:
    long_head = encode_packet(0x91, 1, bytes(8944), boot_id=7)[:100]
    decoder = PacketDecoder(from_board=True)
    assert decoder.feed(long_head) == []
    sound = [encode_packet(0x90, number, boot_id=7) for number in range(8944 // 28)]
    found = [item for raw in sound for item in decoder.feed(raw)]
    assert found[0] == Damage(packets.Defect.BAD_CRC, 100)
    assert [item.sequence for item in found[1:] if isinstance(item, Packet)] == list(range(len(sound)))
