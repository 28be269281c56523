"""Packets survive cutting, damage and garbage, and every byte is accounted for."""

import random
import struct
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import firmware_protocol.packets as packets_module
from firmware_protocol.packets import (
    MAX_PAYLOAD_BYTES,
    PACKET_OVERHEAD_BYTES,
    SYNC,
    Damage,
    Defect,
    ForeignVersion,
    Packet,
    PacketDecoder,
    encode_packet,
)

PAGE = Path(packets_module.__file__).with_name("PROTOCOL.md").read_text()

# Reserved bytes are drawn often, so that false starts happen.
awkward_bytes = st.lists(
    st.one_of(st.sampled_from([b"\xa5", b"\x5a", SYNC, SYNC + b"\x01\x90"]), st.binary(max_size=40)), max_size=8
).map(b"".join)
packets = st.builds(
    Packet,
    type=st.integers(0x80, 0xFF),
    sequence=st.integers(0, 2**32 - 1),
    board_ticks=st.integers(0, 2**64 - 1),
    boot_id=st.integers(0, 2**32 - 1),
    payload=awkward_bytes,
)


def encoded(packet: Packet) -> bytes:
    return encode_packet(
        packet.type, packet.sequence, packet.payload, board_ticks=packet.board_ticks, boot_id=packet.boot_id
    )


def check_accounts(decoder: PacketDecoder) -> None:
    counts = decoder.counts
    parts = counts.accepted + counts.other_version + counts.own_direction + counts.discarded
    assert counts.received == parts + decoder.waiting_bytes


def crc16_bit_by_bit(data: bytes) -> int:
    register = 0xFFFF
    for byte in data:
        register ^= byte << 8
        for _ in range(8):
            register = ((register << 1) ^ 0x1021 if register & 0x8000 else register << 1) & 0xFFFF
    return register


def test_layout_is_the_one_of_the_page() -> None:
    raw = encode_packet(0x90, 7, b"abc", board_ticks=2**40 + 5, boot_id=0xDEADBEEF)
    assert raw[:2] == bytes.fromhex("A55A")
    assert raw[2:4] == bytes((1, 0x90))
    assert struct.unpack_from("<IQIH", raw, 4) == (7, 2**40 + 5, 0xDEADBEEF, 3)
    assert int.from_bytes(raw[22:24], "little") == crc16_bit_by_bit(raw[:22])
    assert raw[24:27] == b"abc"
    assert int.from_bytes(raw[27:], "little") == zlib.crc32(raw[:27])
    assert len(raw) == 3 + PACKET_OVERHEAD_BYTES == 31


def test_examples_on_the_page_are_packets() -> None:
    blocks = PAGE.split("## 6. Example")[1].split("\n\n")
    examples = [bytes.fromhex(block) for block in blocks if block.startswith("    A5")]
    host_to_board, board_to_host = examples
    (request,) = PacketDecoder(from_board=False).feed(host_to_board)
    (answer,) = PacketDecoder(from_board=True).feed(board_to_host)
    assert isinstance(request, Packet)
    assert isinstance(answer, Packet)
    assert (request.type, request.sequence) == (0x01, 1)
    assert (answer.type, answer.board_ticks, answer.boot_id) == (0x81, 1000, 0x11223344)


@given(st.lists(st.one_of(packets, awkward_bytes), max_size=12), st.data())
def test_any_cutting_gives_the_same_packets(pieces: list[Packet | bytes], data: st.DataObject) -> None:
    stream = b"".join(encoded(piece) if isinstance(piece, Packet) else piece for piece in pieces)
    whole = PacketDecoder(from_board=True)
    expected = whole.feed(stream)
    check_accounts(whole)

    cut = PacketDecoder(from_board=True)
    found = []
    position = 0
    while position < len(stream):
        size = data.draw(st.integers(1, min(len(stream) - position, 40)))
        found += cut.feed(stream[position : position + size])
        check_accounts(cut)
        position += size
    assert found == expected
    assert cut.counts == whole.counts


@given(st.lists(packets, min_size=1, max_size=6))
def test_clean_stream_gives_every_packet_and_nothing_else(sent: list[Packet]) -> None:
    decoder = PacketDecoder(from_board=True)
    assert decoder.feed(b"".join(map(encoded, sent))) == sent
    assert decoder.counts.discarded == 0
    assert decoder.waiting_bytes == 0


def corrupt(raw: bytes, rng: random.Random) -> bytes:
    """Return the packet with one or two bits, a burst of up to 16 bits, or its end missing."""
    damaged = bytearray(raw)
    kind = rng.randrange(4)
    if kind == 3:
        return bytes(damaged[: rng.randrange(1, len(raw))])
    if kind == 2:
        start, width = rng.randrange(len(raw) * 8), rng.randrange(2, 17)
        bits = [start, *(b for b in range(start + 1, min(start + width, len(raw) * 8)) if rng.random() < 0.5)]
    else:
        bits = rng.sample(range(len(raw) * 8), kind + 1)
    for bit in bits:
        damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


def forged_and_lost(count: int, seed: int) -> tuple[int, int]:
    """Send sound and damaged packets in turn; return how many came out that nobody sent, and sound ones lost."""
    rng = random.Random(seed)
    decoder = PacketDecoder(from_board=True)
    found: list[Packet] = []
    sent = set()
    for number in range(count):
        broken = Packet(0x90, 2 * number, 0, 1, rng.randbytes(44))
        sound = Packet(0x90, 2 * number + 1, 0, 1, b"sound")
        raw = corrupt(encoded(broken), rng)
        if encoded(broken).startswith(raw) and (raw + encoded(sound)).startswith(encoded(broken)):
            continue  # what was cut off is what follows, by chance: nothing is damaged
        sent.add(sound)
        found += [item for item in decoder.feed(raw + encoded(sound)) if isinstance(item, Packet)]
    found += [item for item in decoder.feed(bytes(MAX_PAYLOAD_BYTES + 100)) if isinstance(item, Packet)]
    check_accounts(decoder)
    return len(set(found) - sent), len(sent - set(found))


def test_no_damaged_packet_is_accepted_and_the_next_one_is_found() -> None:
    assert forged_and_lost(20_000, seed=1) == (0, 0)


def test_without_the_crc_damage_would_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packets_module, "crc32", lambda _: 0)
    forged, _ = forged_and_lost(2_000, seed=1)
    assert forged > 0


@pytest.mark.parametrize(
    ("spoiled_byte", "defect"),
    [(0, Defect.GARBAGE), (5, Defect.BAD_HEADER), (23, Defect.BAD_HEADER), (30, Defect.BAD_CRC)],
)
def test_damage_says_what_and_how_much(spoiled_byte: int, defect: Defect) -> None:
    raw = bytearray(encode_packet(0x90, 1, b"payload", boot_id=1))
    raw[spoiled_byte] ^= 0x01
    decoder = PacketDecoder(from_board=True)
    damage, packet = decoder.feed(bytes(raw) + encode_packet(0x90, 2, boot_id=1))
    assert damage == Damage(defect, len(raw))
    assert isinstance(packet, Packet)
    assert packet.sequence == 2


def test_an_impossible_length_is_not_waited_for() -> None:
    head = struct.pack("<2sBBIQIH", SYNC, 1, 0x90, 0, 0, 1, 0xFFFF)
    decoder = PacketDecoder(from_board=True)
    found = decoder.feed(head + crc16_bit_by_bit(head).to_bytes(2, "little") + encode_packet(0x90, 2, boot_id=1))
    assert found[0] == Damage(Defect.BAD_LENGTH, 24)
    assert isinstance(found[1], Packet)


def test_other_major_version_is_named_and_counted() -> None:
    raw = encode_packet(0x81, 1, b"later", boot_id=1, major=2)
    decoder = PacketDecoder(from_board=True)
    assert decoder.feed(raw) == [ForeignVersion(2)]
    assert decoder.counts.other_version == len(raw)


def test_an_echo_is_no_message() -> None:
    raw = encode_packet(0x01, 1)
    decoder = PacketDecoder(from_board=True)
    assert decoder.feed(raw) == []
    assert decoder.counts.own_direction == len(raw)


def test_memory_stays_bounded_whatever_comes() -> None:
    rng = random.Random(3)
    decoder = PacketDecoder(from_board=True)
    for _ in range(300):
        decoder.feed(rng.choice([rng.randbytes(1000), SYNC * 500, b"\xa5" * 1000, encode_packet(0x90, 1)[:-1]]))
        assert decoder.waiting_bytes < MAX_PAYLOAD_BYTES + PACKET_OVERHEAD_BYTES
        check_accounts(decoder)


def test_too_large_a_payload_is_refused() -> None:
    with pytest.raises(ValueError, match="at most 8944 bytes, got 8945"):
        encode_packet(0x90, 0, bytes(MAX_PAYLOAD_BYTES + 1))
