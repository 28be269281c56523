"""A block of many gates as arrays."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats, Integers
from resonator_daemon.estimate.tones.frequency_estimators import FREQUENCY_JUMP, WRAP_MASK, Sums
from resonator_daemon.estimate.tones.gate_block import GateBlock
from resonator_daemon.estimate.tones.record_checks import Gate

_EXACT_IN_64_BITS: Final = 2.0**62  # N^2 T, in which 6 (2 S2 - (N - 1) S1) has room, whatever wraps on the way


def as_arrays(gates: Sequence[Sequence[Gate]], rows: int) -> tuple[Integers, Floats]:
    """Return the gates of each channel as the last rows of arrays: sums (8, rows, channels), lines (2, rows, channels).

    The lines are frequency and residual. Rows of gates that are not there are zero.
    """
    sums, lines = np.zeros((8, rows, len(gates)), np.int64), np.zeros((2, rows, len(gates)))
    for channel, column in enumerate(gates):
        if column:
            sums[:, -len(column) :, channel] = np.array([counts[:8] for counts, _, _ in column]).T
            lines[:, -len(column) :, channel] = np.array([line for _, *line in column]).T
    return sums, lines


def begins(sums: Integers, frequency_hz: Floats) -> NDArray[np.bool_]:
    """Return which gates after the first do not continue the one before: stamps are missing or the tone changed."""
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


class ManyGates(GateBlock):
    """Gates as arrays.

    Parameters
    ----------
    before
        How many of the gates in `sums` and `lines` are older than the block.
    sums
        (8, before + n, channels), as of `Gates`.
    lines
        (2, before + n, channels): frequency and residual.
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
        lines: Floats,
        fault: NDArray[np.int8],
        held: list[list[int]],
        attenuation_db256: NDArray[np.uint16],
        reference_hz: float,
    ) -> None:
        self._before = before
        self._sums = sums
        self._lines = lines
        self.held = held
        self.steady = False
        self.faults = fault.tolist() if fault.any() else []
        self._attenuation_db256 = attenuation_db256
        self._reference_hz = reference_hz

    def gates_held(self, channel: int, count: int) -> list[Gate]:
        """Return the last `count` gates of a channel."""
        start = self._sums.shape[1] - count
        sums, lines = self._sums[:, start:, channel].T.tolist(), self._lines[:, start:, channel].tolist()
        return [((*fields, fields[2] - 2), *line) for fields, *line in zip(sums, *lines, strict=True)]

    def other_tones(self, pilot_hz: float, tolerance: float) -> list[list[bool]]:
        off = np.abs(self._lines[0, self._before :] / pilot_hz - 1.0) >= tolerance
        rows: list[list[bool]] = off.tolist() if off.any() else []
        return rows

    def attenuation_db(self, gate: int) -> list[float]:
        return [db256 / 256.0 for db256 in self._attenuation_db256[gate].tolist()]

    def last(self, gate: int, frames: int) -> tuple[list[list[float]], list[list[float]]]:
        end = self._before + gate + 1
        hertz, residuals = self._lines[:, end - frames : end]
        return hertz.T.tolist(), residuals.T.tolist()

    def windows(self, gates: Sequence[int], frames: Sequence[int]) -> "_ManyWindows":
        """Add up windows: `frames[i]` gates that end with `gates[i]`, on each channel."""
        end = np.array(gates) + self._before
        start = end - np.array(frames) + 1
        held = np.array([self.held[gate] for gate in gates]) >= np.array(frames)[:, None]
        found = _add_up(self._sums, start, end)
        stride, stamps, span = found[:3].astype(np.float64)
        size = stamps * stamps * np.maximum(span, stride * stamps)
        if bool((held & ~(size < _EXACT_IN_64_BITS)).any()):
            found = _add_up(self._sums.astype(object), start, end)
        return _ManyWindows(found, held, self._reference_hz)


def _add_up(sums: Integers, start: NDArray[np.intp], end: NDArray[np.intp]) -> Integers:
    """Add up the gates from `start` to `end`, (k,), the last one included: (7, k, channels), see `_ManyWindows`.

    As `merge_adjacent` does, by differences of sums that run over all gates. They are exact also where these
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


class _ManyWindows:
    """Stride, stamps, span, S1, S2, Q2 and number of second differences of k windows, (7, k, channels)."""

    def __init__(self, sums: Integers, held: NDArray[np.bool_], reference_hz: float) -> None:
        self._sums = sums
        self._held = held
        stride, stamps, _, s1, s2, _, _ = sums
        edges = stride * stamps * (stamps * stamps - 1)
        ticks = 6 * (2 * s2 - (stamps - 1) * s1)
        with np.errstate(divide="ignore", invalid="ignore"):
            frequency = reference_hz * (edges.astype(np.float64) / ticks.astype(np.float64))
        self._frequency_hz: list[list[float]] = np.where(held, frequency, math.nan).tolist()

    def frequency_hz(self, window: int) -> list[float]:
        return self._frequency_hz[window]

    def sums(self, window: int) -> list[Sums | None]:
        parts = zip(self._held[window].tolist(), *self._sums[:, window].tolist(), strict=True)
        return [
            Sums(0, 0, stamps, stride, span, s1, s2, q2, differences) if held else None
            for held, stride, stamps, span, s1, s2, q2, differences in parts
        ]
