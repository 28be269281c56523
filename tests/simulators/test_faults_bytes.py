"""Damaged bytes: as many as asked for, where they are said to be, and counted exactly."""

from collections import Counter

import numpy as np
import pytest

from firmware_protocol.layouts import MessageType
from firmware_protocol.packets import encode_packet
from simulators.faults import FaultPlan
from simulators.faults.account import FaultCounts
from simulators.faults.byte_faults import ByteFaults

FRAME_BYTES = 204


class Wire:
    """Damages frames one after the other and adds up what was done."""

    def __init__(self, seed: int = 1, **faults: float) -> None:
        self._faults = ByteFaults(FaultPlan.model_validate(faults), seed)
        self.counts = FaultCounts()
        self.sent_bytes = 0

    def send(self, packets: bytes, elapsed_s: float = 0.0) -> bytes:
        data, harm = self._faults.damage(packets, elapsed_s)
        self.counts.add(harm or FaultCounts())
        self.sent_bytes += len(data)
        return data


def frame(sequence: int) -> bytes:
    return encode_packet(MessageType.FRAME, sequence, bytes(176))


def flipped_bits(before: bytes, after: bytes) -> list[int]:
    difference = np.frombuffer(before, np.uint8) ^ np.frombuffer(after, np.uint8)
    return np.flatnonzero(np.unpackbits(difference, bitorder="little")).tolist()


def test_bits_flip_independently_at_the_rate_asked_for_and_are_counted() -> None:
    wire = Wire(bit_error_rate=1e-3)
    positions: list[int] = []
    hit = []
    for sequence in range(3000):
        whole = frame(sequence)
        flipped = flipped_bits(whole, wire.send(frame(sequence)))
        positions += [sequence * 8 * FRAME_BYTES + bit for bit in flipped]
        hit += [sequence] if flipped else []
    assert wire.counts.bits_flipped == len(positions)
    assert wire.counts.frame_sequences_hit == hit
    assert wire.counts.frames_hit == wire.counts.packets_hit == len(hit)
    assert wire.counts.parts_hit == 0
    # 4.9 million bits: 4896 flips expected, standard deviation 70; gaps exponential; no place in a byte preferred.
    assert len(positions) == pytest.approx(4896, abs=280)
    gaps = np.diff(positions)
    assert gaps.mean() == pytest.approx(1000, rel=0.06)
    assert gaps.std() == pytest.approx(1000, rel=0.08)
    assert (gaps < 693).mean() == pytest.approx(0.5, abs=0.03)
    assert np.bincount(np.array(positions) % 8).min() > 500


@pytest.mark.parametrize("length", [1, 2, 5, 16])
def test_a_burst_is_as_long_as_asked_for_and_hits_one_frame(length: int) -> None:
    wire = Wire(burst_rate_hz=100.0, burst_bits=length)
    inner, places = Counter[int](), set()
    for sequence in range(4000):
        flipped = flipped_bits(frame(sequence), wire.send(frame(sequence), sequence * 1e-3))
        if flipped:
            assert sequence == wire.counts.frame_sequences_hit[-1]
            assert flipped[-1] - flipped[0] == length - 1
            inner[len(flipped)] += 1
            places.add(flipped[0] // 8)
    assert wire.counts.bursts == wire.counts.frames_hit == inner.total() == pytest.approx(400, abs=80)
    assert wire.counts.bits_flipped == sum(count * times for count, times in inner.items())
    assert len(inner) > 5 if length == 16 else len(inner) <= length
    assert max(places) - min(places) > 190
