"""Sliding windows of a single-tone counter: the last gates of each channel with continuous stamps.

Gates are lists and plain floats: a step has few of them, for which arrays take longer.
"""

import math
from collections import Counter
from collections.abc import Sequence
from operator import itemgetter
from typing import Final, NamedTuple

from firmware_protocol.layouts import SINGLE_TONE_STRUCT, RecordFlag, SingleToneRecord
from resonator_daemon.estimate.tones.frequency_estimators import (
    FREQUENCY_JUMP,
    WRAP_MASK,
    Sums,
    frequency_hz,
    merge_adjacent,
)
from resonator_daemon.estimate.tones.record_checks import FAULTS, Gate, read_gates

_STRIDE_BREAK: Final = int(RecordFlag.STRIDE_BREAK)
_FLAGS: Final = SingleToneRecord._fields.index("flags")
_ATTENUATION: Final = SingleToneRecord._fields.index("attenuation_db256")
_SUMS: Final = itemgetter(0)  # of a gate
_NOTHING: Final[Gate] = (Sums(*[0] * 9), math.nan, math.nan)


class Column(NamedTuple):
    """Gates of one channel: those of before, `before` of them, and those of the block.

    `firsts` has, for each gate of the block, where the gates of its tone begin; behind itself if it has a fault.
    """

    gates: list[Gate]
    before: int
    firsts: list[int]


class GateBlock:
    """A block of adjacent gates, and the windows that end with each of them.

    Attributes
    ----------
    columns
        Gates by channel.
    records
        As on the wire: one of each channel, gate after gate.
    reference_hz
        Rate of the board's ticks.
    held
        By gate and channel: how many gates of the same tone there are, up to the length of the window.
    faults
        By gate and channel, as codes of `FAULTS`; empty where no record has one.
    steady
        All windows were full before, and no tone has changed.
    """

    def __init__(
        self,
        columns: Sequence[Column],
        most: int,
        faults: list[list[int]],
        records: Sequence[tuple[int, ...]],
        reference_hz: float,
    ) -> None:
        """Initialise with the gates of each channel, `most` of which make a window."""
        self.columns = columns
        self.faults = faults
        self.records = records
        self.reference_hz = reference_hz
        self.steady = False
        for _, before, firsts in columns:
            if before != most or firsts[-1]:
                break
        else:
            self.steady = True
            self.held = [[most] * len(columns)] * len(columns[0].firsts)
            return
        held = [
            [min(end - first, most) for end, first in enumerate(firsts, before + 1)] for _, before, firsts in columns
        ]
        self.held = [list(row) for row in zip(*held, strict=True)]

    def count_faults(self) -> Counter[str]:
        """Count the records that gave no frequency, by cause."""
        return Counter(str(FAULTS[code]) for codes in self.faults for code in codes if code)

    def other_tones(self, pilot_hz: float, tolerance: float) -> list[list[bool]]:
        """Return, by gate and channel, whether a tone is off the pilot by more than this ratio; empty: none is."""
        low, high = -tolerance, tolerance
        off = [
            [not low < hertz / pilot_hz - 1.0 < high for _, hertz, _ in gates[before:]]
            for gates, before, _ in self.columns
        ]
        return [list(row) for row in zip(*off, strict=True)] if any(map(any, off)) else []

    def window(self, gate: int, frames: int) -> "Window":
        """Return the window of `frames` gates that ends with `gate`."""
        return Window(self, gate, frames)


class Window:
    """What the channels have counted in the last gates of a block, up to one of them.

    Attributes
    ----------
    frames
        Gates of the window.
    held
        By channel: how many gates of the same tone there are, up to the length of a full window.
    faults
        By channel: the fault of the last gate; None where there is none.
    """

    def __init__(self, block: GateBlock, gate: int, frames: int) -> None:
        self.frames = frames
        self.held = block.held[gate]
        self.faults = [FAULTS[code] for code in block.faults[gate]] if block.faults else [None] * len(block.columns)
        self._block = block
        self._gate = gate
        self._sums: list[Sums | None] | None = None

    @property
    def frequency_hz(self) -> list[float]:
        """Frequencies by channel; NaN where the window is not held."""
        return [math.nan if part is None else frequency_hz(part, self._block.reference_hz) for part in self.sums]

    @property
    def sums(self) -> list[Sums | None]:
        """Sums by channel; None where the window is not held."""
        if self._sums is None:
            self._sums = []
            for gates, before, firsts in self._block.columns:
                end = before + self._gate + 1
                held = end - firsts[self._gate] >= self.frames
                self._sums.append(merge_adjacent(map(_SUMS, gates[end - self.frames : end])) if held else None)
        return self._sums

    @property
    def attenuation_db(self) -> list[float]:
        """Level of each channel below full scale."""
        first = self._gate * len(self.held)
        return [record[_ATTENUATION] / 256.0 for record in self._block.records[first : first + len(self.held)]]

    @property
    def residual_ticks2(self) -> list[float]:
        """Mean square that the gates' lines leave at their ends, by channel; of channels that hold the window."""
        means = []
        for gates, before, _ in self._block.columns:
            end = before + self._gate + 1
            residuals = [residual for _, _, residual in gates[max(end - self.frames, 0) : end]]
            means.append(sum(residuals) / len(residuals))
        return means


class ToneWindows:
    """The last `frames` gates of each channel, for as long as the same tone's stamps run on without a break.

    Gates come in blocks; how they are cut into blocks changes no result.
    """

    def __init__(self, channels: int, frames: int, reference_hz: float, band_hz: tuple[float, float]) -> None:
        """`band_hz` is the lowest and the highest frequency that the plate could ever send."""
        self.channels = channels
        self._reference_hz = reference_hz
        self._band_hz = band_hz
        self._gates: list[list[Gate]] = [[] for _ in range(channels)]  # those held, the newest last
        self.resize(frames)

    def restart(self) -> None:
        """Discard all gates, as after a gap."""
        self._gates = [[] for _ in range(self.channels)]

    def resize(self, frames: int) -> None:
        """Set the number of gates to hold; the newest stay."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        self.frames = frames
        self._gates = [gates[-frames:] for gates in self._gates]

    def push(self, payload: bytes) -> GateBlock:
        """Append the records of some gates, as on the wire: one of each channel, gate after gate.

        An unusable record empties the window of its channel; one that does not continue the last begins a new window.
        Raises ValueError where the payload is no whole number of gates, at least one.
        """
        count = len(payload) / SINGLE_TONE_STRUCT.size
        if not payload or count % self.channels:
            raise ValueError(f"{count:g} records for {self.channels} channels")
        records = list(SINGLE_TONE_STRUCT.iter_unpack(payload))
        channels, most, reference_hz, band_hz = self.channels, self.frames, self._reference_hz, self._band_hz
        all_read = read_gates(records, reference_hz, band_hz)
        columns: list[Column] = []
        codes = [0] * len(records)
        for channel, gates in enumerate(self._gates):
            before, first, firsts = len(gates), 0, []
            for at in range(channel, len(records), channels):
                read = all_read[at]
                if isinstance(read, int):
                    codes[at] = read
                    gates.append(_NOTHING)
                    first = len(gates)
                else:
                    if first < len(gates):
                        (last_edge, last_ticks, stamps, last_stride_edges, span_ticks, *_), last_hz, _ = gates[-1]
                        (edge, ticks, _, stride_edges, *_), hertz, _ = read
                        gap_ticks = (ticks - last_ticks - span_ticks) & WRAP_MASK
                        if (
                            records[at][_FLAGS] & _STRIDE_BREAK
                            or abs(hertz - last_hz) > FREQUENCY_JUMP * hertz
                            # A stamp is missing, or there is one too many.
                            or stride_edges != last_stride_edges
                            or (last_edge + stamps * stride_edges - edge) & WRAP_MASK
                            or not 0 < gap_ticks * (stamps - 1) < 2 * span_ticks
                        ):
                            first = len(gates)
                    gates.append(read)
                firsts.append(first)
            columns.append(Column(gates, before, firsts))
            self._gates[channel] = gates[max(first, len(gates) - most) :]
        faults = [codes[at : at + channels] for at in range(0, len(codes), channels)] if any(codes) else []
        return GateBlock(columns, most, faults, records, reference_hz)
