"""Damage to bytes on their way from board to host."""

import math

import numpy as np

from firmware_protocol.layouts import MessageType
from firmware_protocol.packets import PACKET_OVERHEAD_BYTES
from simulators.faults.account import FaultCounts
from simulators.faults.plan import FaultPlan

_TYPE_AT = 3  # in a packet
_LENGTH_AT = 20

_SEQUENCE_AT = slice(4, 8)
_LONGEST_GARBAGE_BYTES = 64


class ByteFaults:
    """Damages what goes out, one lot after the other.

    A lot's packets are damaged one by one: bits flip, a burst of them, two pieces change places, or bytes are
    lost. Those unharmed may go out twice.
    """

    def __init__(self, plan: FaultPlan, seed: int) -> None:
        self._plan = plan
        self._random = np.random.default_rng((seed, 1))
        self._clean_bits = self._clean_bits_ahead()
        self._next_garbage_s = self._gap_s(plan.garbage_rate_hz)
        self._next_burst_s = self._gap_s(plan.burst_rate_hz)
        self._next_loss_s = self._gap_s(plan.lost_chunk_rate_hz)
        self._still_to_lose_bytes = 0
        self._draws_for_each = plan.duplicate_rate > 0.0 or plan.reorder_rate > 0.0
        nearest_s = min(self._next_garbage_s, self._next_burst_s, self._next_loss_s)
        self.harmless = math.isinf(self._clean_bits) and math.isinf(nearest_s) and not self._draws_for_each

    def damage(self, data: bytes, elapsed_s: float) -> tuple[bytes, FaultCounts | None]:
        """Return what is sent instead of these packets, `elapsed_s` after the first START, and the damage done."""
        bits = 8 * len(data)
        due_s = min(self._next_garbage_s, self._next_burst_s, self._next_loss_s)
        busy = self._draws_for_each or self._still_to_lose_bytes > 0
        if self._clean_bits >= bits and elapsed_s < due_s and not busy:
            self._clean_bits -= bits
            return data, None
        harm = FaultCounts()
        garbage = self._garbage(elapsed_s, harm)
        packets = b"".join(self._damaged(packet, elapsed_s, harm) for packet in packets_in(data))
        return garbage + packets, harm

    def _damaged(self, packet: bytes, elapsed_s: float, harm: FaultCounts) -> bytes:
        damaged = self._flip_bits(packet, harm)
        if elapsed_s >= self._next_burst_s:
            self._next_burst_s = elapsed_s + self._gap_s(self._plan.burst_rate_hz)
            damaged = self._burst(damaged, harm)
        if self._chance(self._plan.reorder_rate):
            cut = int(self._random.integers(1, len(damaged)))
            damaged = damaged[cut:] + damaged[:cut]
            harm.chunks_reordered += 1
        damaged = self._lose(damaged, elapsed_s, harm)
        kind, sequence = packet[_TYPE_AT], int.from_bytes(packet[_SEQUENCE_AT], "little")
        if damaged != packet:
            harm.packets_hit += 1
            harm.parts_hit += kind == MessageType.FRAME_PART
            if kind == MessageType.FRAME:
                harm.frames_hit += 1
                harm.frame_sequences_hit.append(sequence)
        elif self._chance(self._plan.duplicate_rate):  # two pieces in the wrong order, twice, hold a sound packet
            harm.packets_duplicated += 1
            harm.bytes_duplicated += len(damaged)
            if kind == MessageType.FRAME:
                harm.frame_sequences_duplicated.append(sequence)
            damaged *= 2
        return damaged

    def _flip_bits(self, packet: bytes, harm: FaultCounts) -> bytes:
        bits = 8 * len(packet)
        if self._clean_bits >= bits:
            self._clean_bits -= bits
            return packet
        damaged = bytearray(packet)
        position = self._clean_bits
        while position < bits:
            damaged[int(position) // 8] ^= 1 << int(position) % 8
            harm.bits_flipped += 1
            position += 1 + self._clean_bits_ahead()
        self._clean_bits = position - bits
        return bytes(damaged)

    def _burst(self, packet: bytes, harm: FaultCounts) -> bytes:
        length = self._plan.burst_bits
        inner = int(self._random.integers(0, 1 << max(length - 2, 0)))
        mask = (1 << (length - 1)) | inner << 1 | 1
        shift = int(self._random.integers(0, 8 * len(packet) - length + 1))
        harm.bursts += 1
        harm.bits_flipped += mask.bit_count()
        return (int.from_bytes(packet, "little") ^ mask << shift).to_bytes(len(packet), "little")

    def _lose(self, packet: bytes, elapsed_s: float, harm: FaultCounts) -> bytes:
        start = 0
        if not self._still_to_lose_bytes:
            if elapsed_s < self._next_loss_s:
                return packet
            self._next_loss_s = elapsed_s + self._gap_s(self._plan.lost_chunk_rate_hz)
            self._still_to_lose_bytes = int(self._random.integers(1, self._plan.lost_chunk_bytes + 1))
            start = int(self._random.integers(0, len(packet)))
            harm.chunks_lost += 1
        lost = min(self._still_to_lose_bytes, len(packet) - start)
        self._still_to_lose_bytes -= lost
        harm.bytes_lost += lost
        return packet[:start] + packet[start + lost :]

    def _garbage(self, elapsed_s: float, harm: FaultCounts) -> bytes:
        if elapsed_s < self._next_garbage_s:
            return b""
        self._next_garbage_s = elapsed_s + self._gap_s(self._plan.garbage_rate_hz)
        garbage = self._random.bytes(int(self._random.integers(1, _LONGEST_GARBAGE_BYTES + 1)))
        harm.garbage_bytes += len(garbage)
        harm.garbage_bursts += 1
        return garbage

    def _chance(self, rate: float) -> bool:
        return rate > 0.0 and bool(self._random.random() < rate)

    def _clean_bits_ahead(self) -> float:
        """Draw how many bits pass unharmed before the next one that is flipped."""
        rate = self._plan.bit_error_rate
        return float(self._random.geometric(rate) - 1) if rate > 0.0 else math.inf

    def _gap_s(self, rate_hz: float) -> float:
        return float(self._random.exponential(1.0 / rate_hz)) if rate_hz > 0.0 else math.inf


def packets_in(data: bytes) -> list[bytes]:
    """Split undamaged packets that follow each other."""
    packets, start = [], 0
    while start < len(data):
        payload_bytes = int.from_bytes(data[start + _LENGTH_AT : start + _LENGTH_AT + 2], "little")
        end = start + PACKET_OVERHEAD_BYTES + payload_bytes
        packets.append(data[start:end])
        start = end
    return packets
