"""Where the stamps of a gate lie: every stride-th edge of a tone, on a line, going on from gate to gate."""

from typing import NamedTuple

import numpy as np

from simulators.arrays import Bools, Floats, Integers


class Strides(NamedTuple):
    """The undisturbed stamps of n gates, each (n, channels); all 0 where there was no tone."""

    gate_start_ticks: Integers  # (n, 1), not wrapped
    first_edge: Integers  # of the first stamp, not wrapped
    stamps: Integers
    first_ticks: Floats  # of the first stamp since the gate's start, not rounded
    period_ticks: Floats  # from stamp to stamp


class StampErrors(NamedTuple):
    """What moves the stamps of n gates off their lines, besides beats and the tick that they are rounded to.

    Each (n, channels). The frequency of a gate is its mean one; within it the phase strays, and is back at the end.
    """

    jitter_ticks: Floats  # standard deviation, white
    strayed_ticks: Floats  # mean over the gate's stamps, of where they are off the line by the phase that strays
    tilt_ticks: Floats  # what that adds from the gate's start to its end to a regression through its stamps


class StampSums(NamedTuple):
    """Fields of a single-tone record, each (n, channels), all 0 where there was no tone."""

    first_edge: Integers  # not wrapped yet
    first_ticks: Integers  # not wrapped yet
    stamps: Integers
    span_ticks: Integers
    s1_ticks: Integers
    s2_ticks: Integers
    q2_ticks2: Integers


class StrideCounter:
    """Counts on across gates: a gate's first stamp follows the last one's last by one stride of edges.

    A stamp belongs to the gate in which its undisturbed edge lies.

    Parameters
    ----------
    channels
        How many tones are counted side by side.
    stride_edges
        Edges between stamps.
    random
        Source of phases.
    strides
        Strides counted before, on every channel.
    """

    def __init__(self, channels: int, stride_edges: int, random: np.random.Generator, strides: int = 0) -> None:
        self._stride_edges = stride_edges
        self._random = random
        self._strides = np.full(channels, strides, dtype=np.int64)
        self._phase = random.random(channels)  # fraction of a stride since the last stamp

    def count(self, board_ticks: int, gate_ticks: int, period_ticks: Floats, broken: Bools) -> Strides:
        """Count n gates.

        Parameters
        ----------
        board_ticks
            Where the first gate starts.
        gate_ticks
            Length of each gate.
        period_ticks
            Ticks in a stride, (n, channels); infinite where there is no tone.
        broken
            Whether a gate's tone is another than the last gate's, so that its phase is too, (n, channels).
        """
        progress = gate_ticks / period_ticks
        jumps = broken * self._random.random(progress.shape)
        ends = self._phase + (jumps + progress).cumsum(axis=0)
        starts = np.concatenate([self._phase[np.newaxis], ends[:-1]]) + jumps
        before = np.floor(starts)
        # A sum in two orders may differ in its last bit: a jump never takes the start beyond the end.
        stamps = np.maximum(np.floor(ends) - before, 0.0).astype(np.int64)
        counted = stamps > 0
        first_edge = (self._strides + before.astype(np.int64) + 1) * self._stride_edges
        whole = np.floor(ends[-1])
        self._strides = self._strides + whole.astype(np.int64)
        self._phase = ends[-1] - whole
        period = np.where(counted, period_ticks, 0.0)
        return Strides(
            board_ticks + gate_ticks * np.arange(len(stamps), dtype=np.int64)[:, np.newaxis],
            first_edge * counted,
            stamps,
            (before + 1.0 - starts) * period,
            period,
        )
