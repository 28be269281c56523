"""Packets survive cutting, damage and garbage, and every byte is accounted for."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from protocol_sessions import check_accounts

from firmware_protocol.packets import (
    MAX_PACKET_BYTES,
    MAX_PAYLOAD_BYTES,
    SYNC,
    Damage,
    Defect,
    Packet,
    PacketDecoder,
    encode_packet,
)

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


def test_memory_stays_bounded_whatever_comes() -> None:
    rng = random.Random(3)
    decoder = PacketDecoder(from_board=True)
    for _ in range(300):
        decoder.feed(rng.choice([rng.randbytes(1000), SYNC * 500, b"\xa5" * 1000, encode_packet(0x90, 1)[:-1]]))
        assert decoder.waiting_bytes < MAX_PACKET_BYTES
        check_accounts(decoder)


@pytest.mark.parametrize("cut", range(1, 31))
def test_an_abandoned_packet_is_discarded(cut: int) -> None:
    raw = encode_packet(0x90, 7, b"abc", boot_id=1)
    decoder = PacketDecoder(from_board=True)
    assert decoder.feed(raw[:cut]) == []
    decoder.abandon()
    assert (decoder.waiting_bytes, decoder.counts.discarded) == (0, cut)
    assert decoder.feed(raw) == [Damage(Defect.GARBAGE, cut), Packet(0x90, 7, 0, 1, b"abc")]


def test_too_large_a_payload_is_refused() -> None:
    with pytest.raises(ValueError, match="at most 8944 bytes, got 8945"):
        encode_packet(0x90, 0, bytes(MAX_PAYLOAD_BYTES + 1))
