"""A block of few gates as lists: for so few, arrays take longer."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from firmware_protocol.layouts import SingleToneRecord
from resonator_daemon.estimate.tones.frequency_estimators import Sums, frequency_hz, merge_adjacent
from resonator_daemon.estimate.tones.gate_block import GateBlock
from resonator_daemon.estimate.tones.record_checks import Gate

_ATTENUATION: Final = SingleToneRecord._fields.index("attenuation_db256")


class Column(NamedTuple):
    """Gates of one channel: those of before, `before` of them, and those of the block.

    `firsts` has, for each gate of the block, where the gates of its tone begin; behind itself if it has a fault.
    """

    gates: list[Gate]
    before: int
    firsts: list[int]


class FewGates(GateBlock):
    """Gates as lists, `most` of which make a window."""

    def __init__(
        self,
        columns: Sequence[Column],
        most: int,
        faults: list[list[int]],
        records: Sequence[tuple[int, ...]],
        reference_hz: float,
    ) -> None:
        self._columns = columns
        self.faults = faults
        self._records = records
        self._reference_hz = reference_hz
        self.steady = all(before == most and not firsts[-1] for _, before, firsts in columns)
        if self.steady:
            self.held = [[most] * len(columns)] * len(columns[0].firsts)
            return
        held = [
            [min(end - first, most) for end, first in enumerate(firsts, before + 1)] for _, before, firsts in columns
        ]
        self.held = [list(row) for row in zip(*held, strict=True)]

    def other_tones(self, pilot_hz: float, tolerance: float) -> list[list[bool]]:
        low, high = -tolerance, tolerance
        off = [
            [not low < hertz / pilot_hz - 1.0 < high for _, hertz, _ in gates[before:]]
            for gates, before, _ in self._columns
        ]
        return [list(row) for row in zip(*off, strict=True)] if any(map(any, off)) else []

    def attenuation_db(self, gate: int) -> list[float]:
        channels = len(self._columns)
        return [record[_ATTENUATION] / 256.0 for record in self._records[gate * channels : (gate + 1) * channels]]

    def last(self, gate: int, frames: int) -> tuple[list[list[float]], list[list[float]]]:
        held = [gates[max(before + gate + 1 - frames, 0) : before + gate + 1] for gates, before, _ in self._columns]
        return [[hertz for _, hertz, _ in gates] for gates in held], [
            [residual_ticks2 for _, _, residual_ticks2 in gates] for gates in held
        ]

    def windows(self, gates: Sequence[int], frames: Sequence[int]) -> "_FewWindows":
        return _FewWindows(self._columns, list(zip(gates, frames, strict=True)), self._reference_hz)


class _FewWindows:
    """Windows whose sums are added up on request."""

    def __init__(self, columns: Sequence[Column], windows: list[tuple[int, int]], reference_hz: float) -> None:
        self._columns = columns
        self._windows = windows
        self._reference_hz = reference_hz
        self._added: tuple[int, list[Sums | None]] = -1, []  # the last one

    def frequency_hz(self, window: int) -> list[float]:
        return [math.nan if part is None else frequency_hz(part, self._reference_hz) for part in self.sums(window)]

    def sums(self, window: int) -> list[Sums | None]:
        if self._added[0] != window:
            gate, count = self._windows[window]
            sums: list[Sums | None] = []
            for gates, before, firsts in self._columns:
                end = before + gate + 1
                held = end - firsts[gate] >= count
                sums.append(merge_adjacent([sums for sums, _, _ in gates[end - count : end]]) if held else None)
            self._added = window, sums
        return self._added[1]
