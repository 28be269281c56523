"""Faults of the way from board to host, injected on purpose and counted exactly."""

import math
from dataclasses import dataclass, field, fields
from difflib import get_close_matches

import numpy as np

from firmware_protocol.layouts import MessageType
from simulators.board import Outgoing

_TYPE_AT = 3  # in a packet
_SEQUENCE_AT = slice(4, 8)
_LONGEST_GARBAGE_BYTES = 64


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """What shall go wrong. Times count from the first START."""

    bit_error_rate: float = 0.0  # share of the bits to the host that arrive flipped
    garbage_rate_hz: float = 0.0  # how often random bytes come between packets
    unplug_at_s: float | None = None
    unplug_for_s: float = 1.0
    reboot_at_s: float | None = None


@dataclass(slots=True)
class FaultCounts:
    """What went wrong. Damage counts once its packets have gone out whole."""

    bits_flipped: int = 0
    packets_hit: int = 0  # of any type, with at least one bit flipped
    frames_hit: int = 0  # single-tone frames among them
    parts_hit: int = 0  # parts of channelised frames among them
    frame_sequences_hit: list[int] = field(default_factory=list)  # of the single-tone frames
    garbage_bytes: int = 0
    garbage_bursts: int = 0
    unplugs: int = 0
    reboots: int = 0

    def add(self, more: "FaultCounts") -> None:
        for count in fields(self):
            setattr(self, count.name, getattr(self, count.name) + getattr(more, count.name))


def parse_faults(spec: str) -> FaultPlan:
    """Read faults written as key=value, separated by commas.

    Raises
    ------
    ValueError
        Unknown key, missing or impossible value; one line for each.
    """
    known = [plan_field.name for plan_field in fields(FaultPlan)]
    values: dict[str, float] = {}
    findings = []
    for item in filter(None, (part.strip() for part in spec.split(","))):
        key, _, text = item.partition("=")
        if key not in known:
            near = get_close_matches(key, known, n=1)
            remedy = f"did you mean {near[0]}?" if near else f"allowed: {', '.join(known)}"
            findings.append(f"faults: {key}: unknown key; {remedy}")
            continue
        limit = 1.0 if key == "bit_error_rate" else 1e9
        try:
            values[key] = float(text)
        except ValueError:
            values[key] = math.nan
        if not 0.0 <= values[key] <= limit:
            findings.append(f"faults: {key}: got {text!r}; must be a number from 0 to {limit:g}")
    if findings:
        raise ValueError("\n".join(findings))
    return FaultPlan(**values)


class FaultInjector:
    """Damages what goes out: call `damage` for one lot after the other, and `sent` when it went out whole."""

    def __init__(self, plan: FaultPlan, seed: int) -> None:
        self._plan = plan
        self._random = np.random.default_rng(seed)
        self._clean_bits = self._clean_bits_ahead()
        self._next_garbage_s = self._garbage_gap_s()
        self._pending: FaultCounts | None = None  # of the lot that is going out
        self.counts = FaultCounts()

    def damage(self, outgoing: Outgoing, elapsed_s: float) -> bytes:
        """Return the bytes that go out instead, `elapsed_s` after the first START."""
        harmless = b"".join(outgoing.packets)
        bits = 8 * len(harmless)
        if self._clean_bits >= bits and elapsed_s < self._next_garbage_s:
            self._clean_bits -= bits
            self._pending = None
            return harmless
        self._pending = harm = FaultCounts()
        garbage = self._garbage(elapsed_s, harm)
        return garbage + b"".join(self._flip_bits(packet, harm) for packet in outgoing.packets)

    def sent(self) -> None:
        if self._pending is not None:
            self.counts.add(self._pending)
            self._pending = None

    def _garbage(self, elapsed_s: float, harm: FaultCounts) -> bytes:
        if elapsed_s < self._next_garbage_s:
            return b""
        self._next_garbage_s = elapsed_s + self._garbage_gap_s()
        garbage = self._random.bytes(int(self._random.integers(1, _LONGEST_GARBAGE_BYTES + 1)))
        harm.garbage_bytes += len(garbage)
        harm.garbage_bursts += 1
        return garbage

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
        harm.packets_hit += 1
        if packet[_TYPE_AT] == MessageType.FRAME:
            harm.frames_hit += 1
            harm.frame_sequences_hit.append(int.from_bytes(packet[_SEQUENCE_AT], "little"))
        elif packet[_TYPE_AT] == MessageType.FRAME_PART:
            harm.parts_hit += 1
        return bytes(damaged)

    def _clean_bits_ahead(self) -> float:
        """Draw how many bits pass unharmed before the next one that is flipped."""
        rate = self._plan.bit_error_rate
        return float(self._random.geometric(rate) - 1) if rate > 0.0 else math.inf

    def _garbage_gap_s(self) -> float:
        rate_hz = self._plan.garbage_rate_hz
        return float(self._random.exponential(1.0 / rate_hz)) if rate_hz > 0.0 else math.inf
