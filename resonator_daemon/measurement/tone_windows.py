"""Sliding windows of a single-tone counter: the last gates of each channel, while the same tone's stamps run on."""

import math
from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import RecordFlag
from resonator_daemon.measurement.counting import FREQUENCY_JUMP, WRAP_MASK, Sums
from resonator_daemon.measurement.force import FloatArray
from resonator_daemon.measurement.other_tones import end_residual_ticks2
from resonator_daemon.measurement.record_checks import FAULTS, RECORD, read_gates

_STRIDE_BREAK: Final = int(RecordFlag.STRIDE_BREAK)
_EXACT_IN_64_BITS: Final = 2.0**62  # N^2 T, in which 6 (2 S2 - (N - 1) S1) has room, whatever wraps on the way

Integers = NDArray[np.int64]


class ToneWindows:
    """The last `frames` gates of each channel, for as long as the same tone's stamps run on without a break.

    Gates come in blocks; how they are cut into blocks changes no result.
    """

    def __init__(self, channels: int, frames: int, reference_hz: float, band_hz: tuple[float, float]) -> None:
        """`band_hz` is the lowest and the highest frequency that the plate could ever send."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        self.channels = channels
        self.frames = frames
        self._reference_hz = reference_hz
        self._band_hz = band_hz
        self._sums = np.zeros((8, frames, channels), np.int64)  # of the last gates, the newest last
        self._lines = np.zeros((2, frames, channels))  # their frequencies, and slopes in ticks per stamp
        self._held = [0] * channels

    def restart(self) -> None:
        """Forget everything, as after a gap."""
        self._held = [0] * self.channels

    def resize(self, frames: int) -> None:
        """Hold so many gates from here; of those held now the newest stay."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        pad = (0, 0), (max(0, frames - self.frames), 0), (0, 0)
        self._sums, self._lines = np.pad(self._sums[:, -frames:], pad), np.pad(self._lines[:, -frames:], pad)
        self.frames = frames
        self._held = [min(held, frames) for held in self._held]

    def push(self, payload: bytes) -> "GateBlock":
        """Take the records of some gates, as on the wire: one of each channel, gate after gate.

        An unusable record empties its channel's window; one that does not run on from the last starts it anew.
        Raises ValueError where the payload is no whole number of gates, at least one.
        """
        if not payload or len(payload) % (RECORD.itemsize * self.channels):
            raise ValueError(f"{len(payload) / RECORD.itemsize:g} records for {self.channels} channels")
        records = np.frombuffer(payload, RECORD).reshape(-1, self.channels)
        before = self.frames
        gates = read_gates(records, self._reference_hz, self._band_hz)
        sums = np.concatenate((self._sums, gates.sums), axis=1)
        lines = np.concatenate((self._lines, (gates.frequency_hz, gates.slope_ticks)), axis=1)
        begins = _begins(sums[:, before - 1 :], lines[0, before - 1 :]) | ((records["flags"] & _STRIDE_BREAK) != 0)
        held = self._count_held(gates.fault, begins)
        self._sums, self._lines = sums[:, -before:], lines[:, -before:]
        self._held = held[-1]
        return GateBlock(before, sums, lines, gates.fault, held, records["attenuation_db256"], self._reference_hz)

    def _count_held(self, fault: NDArray[np.int8], begins: NDArray[np.bool_]) -> list[list[int]]:
        most, held = self.frames, self._held
        if min(held) and not begins.any() and not fault.any():
            if min(held) == most:
                return [held] * len(fault)
            return [[min(count + more, most) for count in held] for more in range(1, len(fault) + 1)]
        rows = []
        for faults, new in zip(fault.tolist(), begins.tolist(), strict=True):
            held = [
                0 if bad else 1 if begin else min(count + 1, most)
                for bad, begin, count in zip(faults, new, held, strict=True)
            ]
            rows.append(held)
        return rows


def _begins(sums: Integers, frequency_hz: FloatArray) -> NDArray[np.bool_]:
    """Tell which gates but the first do not run on from the one before: stamps are missing, or it is another tone."""
    first_edge, first_ticks, stamps, stride, span = sums[:5, :-1]
    next_edge, next_ticks, _, next_stride, _ = sums[:5, 1:]
    gap_ticks = (next_ticks - first_ticks - span) & WRAP_MASK
    hertz = frequency_hz[1:]
    runs_on: NDArray[np.bool_] = (
        (np.abs(hertz - frequency_hz[:-1]) <= FREQUENCY_JUMP * hertz)
        & (next_stride == stride)
        & ((first_edge + stamps * stride - next_edge) & WRAP_MASK == 0)
        & (gap_ticks > 0)
        & (gap_ticks * (stamps - 1) < 2 * span)
    )
    return ~runs_on


class GateBlock:
    """Gates that came together, and the windows that end with each of them.

    Parameters
    ----------
    before
        How many of the gates in `sums` and `lines` are older than the block.
    sums
        (8, before + n, channels), as of `Gates`.
    lines
        (2, before + n, channels): frequency and slope.
    fault
        (n, channels).
    held
        By gate and channel: how many gates of the same tone there are, up to the length of the window.
    attenuation_db256
        (n, channels).
    """

    def __init__(
        self,
        before: int,
        sums: Integers,
        lines: FloatArray,
        fault: NDArray[np.int8],
        held: list[list[int]],
        attenuation_db256: NDArray[np.uint16],
        reference_hz: float,
    ) -> None:
        self._before = before
        self._sums = sums
        self._lines = lines
        self.fault = fault
        self.held = held
        self._attenuation_db256 = attenuation_db256
        self._reference_hz = reference_hz
        self.frequency_hz = lines[0, before:]

    def __len__(self) -> int:
        return len(self.fault)

    def fault_names(self, gate: int) -> list[str | None]:
        """Why each channel of a gate is not usable; None where it is."""
        return [FAULTS[code] for code in self.fault[gate]]

    def count_faults(self) -> Counter[str]:
        """Count the records that gave no frequency, by cause."""
        codes, counts = np.unique(self.fault[self.fault != 0], return_counts=True)
        return Counter({str(FAULTS[code]): int(count) for code, count in zip(codes, counts, strict=True)})

    def attenuation_db(self, gate: int) -> list[float]:
        """Level of each channel below full scale."""
        return [db256 / 256.0 for db256 in self._attenuation_db256[gate].tolist()]

    def last(self, gate: int, frames: int) -> tuple[FloatArray, FloatArray]:
        """Frequencies of the last `frames` gates, and the mean square that their lines leave at their ends, in ticks^2.

        Both (frames, channels); they tell something where so many are held.
        """
        end = self._before + gate + 1
        return self._lines[0, end - frames : end], self._residual_ticks2[end - frames : end]

    @cached_property
    def _residual_ticks2(self) -> FloatArray:
        _, _, stamps, _, span, s1, _, _ = self._sums
        with np.errstate(divide="ignore", invalid="ignore"):
            return end_residual_ticks2(stamps, span, s1, self._lines[1])

    def windows(self, gates: Sequence[int], frames: Sequence[int]) -> "WindowSums":
        """Add up windows: `frames[i]` gates that end with `gates[i]`, on each channel."""
        end = np.array(gates) + self._before
        start = end - np.array(frames) + 1
        held = np.array([self.held[gate] for gate in gates]) >= np.array(frames)[:, None]
        found = _add_up(self._sums, start, end)
        stride, stamps, span = found[:3].astype(np.float64)
        size = stamps * stamps * np.maximum(span, stride * stamps)
        if bool((held & ~(size < _EXACT_IN_64_BITS)).any()):
            found = _add_up(self._sums.astype(object), start, end)
        return WindowSums(found, held, self._reference_hz)


def _add_up(sums: Integers, start: NDArray[np.intp], end: NDArray[np.intp]) -> Integers:
    """Add up the gates from `start` to `end`, (k,), the last one included: (7, k, channels), see `WindowSums`.

    As `counting.merge_adjacent` does, by differences of sums that run over all gates. They are exact also where these
    wrap at 2^64.
    """
    low = int(start.min())
    sums, start, end = sums[:, low : int(end.max()) + 1], start - low, end - low
    _, first_ticks, stamps, stride, span, s1, s2, q2 = sums
    # Of each gate: number and time of its first stamp, from those of the first gate.
    number = np.cumsum(stamps, axis=0) - stamps
    time = np.zeros_like(span)
    # The gap after the last stamp is below a wrap, the whole need not be.
    np.cumsum(span[:-1] + ((first_ticks[1:] - first_ticks[:-1] - span[:-1]) & WRAP_MASK), axis=0, out=time[1:])
    shift = stamps * time
    all_s1 = s1 + shift
    all_s2 = s2 + number * all_s1 + stamps * (stamps - 1) // 2 * time
    running = np.cumsum(np.stack((all_s1, all_s2, q2)), axis=1)
    sum1, sum2, curvature = running[:, end] - running[:, start] + np.stack((all_s1, all_s2, q2))[:, start]
    first, origin = number[start], time[start]
    count = number[end] + stamps[end] - first
    return np.stack(
        (
            stride[start],
            count,
            time[end] + span[end] - origin,
            sum1 - count * origin,
            sum2 - first * sum1 - origin * (count * (count - 1) // 2),
            curvature,
            count - 2 * (end - start + 1)[:, None],
        )
    )


class WindowSums:
    """Sums over k windows, as of `Sums`: those that do not tell where a window begins.

    Attributes
    ----------
    frequency_hz
        Lists by window and channel; NaN where the window is not held.
    """

    def __init__(self, sums: Integers, held: NDArray[np.bool_], reference_hz: float) -> None:
        self._sums = sums
        self._held = held
        stride, stamps, _, s1, s2, _, _ = sums
        edges = stride * stamps * (stamps * stamps - 1)
        ticks = 6 * (2 * s2 - (stamps - 1) * s1)
        with np.errstate(divide="ignore", invalid="ignore"):
            frequency = reference_hz * (edges / np.where(held, ticks, 1)).astype(np.float64)
        self.frequency_hz: list[list[float]] = np.where(held, frequency, math.nan).tolist()

    def sums(self, window: int) -> list[Sums | None]:
        """Return the sums of a window by channel, first edge and tick left out; None where it is not held."""
        parts = zip(self._held[window].tolist(), *self._sums[:, window].tolist(), strict=True)
        return [
            Sums(0, 0, stamps, stride, span, s1, s2, q2, differences) if held else None
            for held, stride, stamps, span, s1, s2, q2, differences in parts
        ]
