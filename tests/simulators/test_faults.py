"""Injected faults: as many as asked for, where they are said to be, and counted exactly."""

import numpy as np
import pytest

from firmware_protocol.layouts import MessageType
from firmware_protocol.packets import Packet, PacketDecoder, encode_packet
from simulators.board import Outgoing
from simulators.faults import FaultCounts, FaultInjector, FaultPlan, parse_faults


def frame(sequence: int) -> Outgoing:
    return Outgoing((encode_packet(MessageType.FRAME, sequence, bytes(176)),), is_frame=True)


def parts(sequence: int) -> Outgoing:
    return Outgoing(
        tuple(encode_packet(MessageType.FRAME_PART, sequence, bytes(8000)) for _ in range(20)), is_frame=True
    )


def flipped_bits(before: bytes, after: bytes) -> list[int]:
    difference = np.frombuffer(before, np.uint8) ^ np.frombuffer(after, np.uint8)
    return np.flatnonzero(np.unpackbits(difference, bitorder="little")).tolist()


def test_without_faults_nothing_is_touched() -> None:
    injector = FaultInjector(FaultPlan(), seed=1)
    for sequence in range(100):
        assert injector.damage(frame(sequence), 1e6) == frame(sequence).packets[0]
        injector.sent()
    assert injector.counts == FaultCounts()


def test_bits_flip_independently_at_the_rate_asked_for_and_are_counted() -> None:
    injector = FaultInjector(FaultPlan(bit_error_rate=1e-3), seed=1)
    positions: list[int] = []
    hit = []
    for sequence in range(3000):
        whole = frame(sequence).packets[0]
        flipped = flipped_bits(whole, injector.damage(frame(sequence), 0.0))
        injector.sent()
        positions += [sequence * 8 * 204 + bit for bit in flipped]
        hit += [sequence] if flipped else []
    assert injector.counts.bits_flipped == len(positions)
    assert injector.counts.frame_sequences_hit == hit
    assert injector.counts.frames_hit == injector.counts.packets_hit == len(hit)
    assert injector.counts.parts_hit == 0
    # 4.9 million bits: 4896 flips expected, standard deviation 70; gaps exponential; no place in a byte preferred.
    assert len(positions) == pytest.approx(4896, abs=280)
    gaps = np.diff(positions)
    assert gaps.mean() == pytest.approx(1000, rel=0.06)
    assert gaps.std() == pytest.approx(1000, rel=0.08)
    assert (gaps < 693).mean() == pytest.approx(0.5, abs=0.03)
    assert np.bincount(np.array(positions) % 8).min() > 500


def test_at_a_rate_of_1_every_bit_flips() -> None:
    injector = FaultInjector(FaultPlan(bit_error_rate=1.0), seed=1)
    for sequence in range(3):
        whole = frame(sequence).packets[0]
        assert injector.damage(frame(sequence), 0.0) == bytes(255 - byte for byte in whole)
        injector.sent()
    assert injector.counts.bits_flipped == 3 * 8 * 204


def test_parts_are_counted_one_by_one() -> None:
    injector = FaultInjector(FaultPlan(bit_error_rate=3e-6), seed=2)
    hit = 0
    for sequence in range(40):
        whole = parts(sequence)
        damaged = injector.damage(whole, 0.0)
        injector.sent()
        size = len(whole.packets[0])
        hit += sum(damaged[k * size : (k + 1) * size] != packet for k, packet in enumerate(whole.packets))
    assert injector.counts.parts_hit == injector.counts.packets_hit == hit > 50
    assert injector.counts.frames_hit == 0
    assert injector.counts.bits_flipped >= hit


def test_damage_that_did_not_go_out_does_not_count() -> None:
    injector = FaultInjector(FaultPlan(bit_error_rate=0.1), seed=2)
    injector.damage(frame(1), 0.0)
    injector.damage(frame(2), 0.0)
    injector.sent()
    injector.sent()
    assert injector.counts.frame_sequences_hit == [2]

    injector = FaultInjector(FaultPlan(garbage_rate_hz=1.0), seed=2)
    assert len(injector.damage(frame(1), 1e6)) > 204
    assert len(injector.damage(frame(2), 0.0)) == 204
    injector.sent()
    assert injector.counts == FaultCounts()


def test_damaged_frames_are_those_that_a_decoder_misses() -> None:
    injector = FaultInjector(FaultPlan(bit_error_rate=2e-4, garbage_rate_hz=100.0), seed=3)
    decoder = PacketDecoder(from_board=True)
    received = []
    sent_bytes = 0
    for sequence in range(2000):
        data = injector.damage(frame(sequence), sequence * 1e-3)
        injector.sent()
        sent_bytes += len(data)
        received += [found.sequence for found in decoder.feed(data) if isinstance(found, Packet)]
    assert sorted(received + injector.counts.frame_sequences_hit) == list(range(2000))
    assert sent_bytes == 2000 * 204 + injector.counts.garbage_bytes
    assert injector.counts.garbage_bursts == pytest.approx(200, abs=45)
    assert (
        decoder.counts.discarded + decoder.waiting_bytes
        == 204 * injector.counts.frames_hit + injector.counts.garbage_bytes
    )


def test_a_spec_is_read_key_by_key() -> None:
    assert parse_faults("") == FaultPlan()
    assert parse_faults(
        "bit_error_rate=1e-5, unplug_at_s=2,unplug_for_s=0.5,reboot_at_s=4,garbage_rate_hz=3"
    ) == FaultPlan(bit_error_rate=1e-5, unplug_at_s=2.0, unplug_for_s=0.5, reboot_at_s=4.0, garbage_rate_hz=3.0)


def test_every_mistake_in_a_spec_is_named() -> None:
    with pytest.raises(ValueError, match="faults") as caught:
        parse_faults("bit_eror_rate=1e-5,unplug_at_s=soon,bit_error_rate=2,reboot_at_s,garbage_rate_hz=nan,noise=1")
    lines = str(caught.value).splitlines()
    assert len(lines) == 6
    assert "did you mean bit_error_rate?" in lines[0]
    assert "unplug_at_s: got 'soon'" in lines[1]
    assert "from 0 to 1" in lines[2]
    assert "allowed:" in lines[5]
