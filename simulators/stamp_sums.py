"""Integer sums over the time stamps of a gate, in closed form: no stamp is ever made.

Within a gate the frequency is constant, so every stride-th edge lies on a line; each stamp is off it by an error e_k,
white, of the input's jitter and the tick it is rounded to. The sums of a line are polynomials in the number of stamps;
the sums of e_k and k e_k are jointly normal. First and last stamp are drawn themselves, since they stand in a record.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntegerArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_ROUNDING_VARIANCE = 1.0 / 12.0  # ticks^2, of a stamp rounded to its tick


class StampSums(NamedTuple):
    """Fields of a single-tone record, each (n, channels), all 0 where nothing was heard."""

    first_edge: IntegerArray  # not wrapped yet
    first_ticks: IntegerArray  # not wrapped yet
    stamps: IntegerArray
    span_ticks: IntegerArray
    s1_ticks: IntegerArray
    s2_ticks: IntegerArray
    q2_ticks2: IntegerArray


class StampCounter:
    """Counts on across gates: a gate's first stamp follows the last one's last by one stride of edges.

    Parameters
    ----------
    channels
        How many tones are counted side by side.
    stride_edges
        Edges between stamps.
    random
        Source of stamp errors.
    strides
        Strides counted before, on every channel.
    """

    def __init__(self, channels: int, stride_edges: int, random: np.random.Generator, strides: int = 0) -> None:
        self._stride_edges = stride_edges
        self._random = random
        self._strides = np.full(channels, strides, dtype=np.int64)
        self._phase = random.random(channels)  # fraction of a stride since the last stamp

    def count(
        self, board_ticks: int, gate_ticks: int, period_ticks: FloatArray, jitter_ticks: FloatArray, broken: BoolArray
    ) -> StampSums:
        """Count n gates.

        Parameters
        ----------
        board_ticks
            Where the first gate starts.
        gate_ticks
            Length of each gate.
        period_ticks
            Ticks in a stride, (n, channels); infinite where nothing is heard.
        jitter_ticks
            Standard deviation of a stamp before it is rounded, (n, channels).
        broken
            Whether a gate's tone is another than the last gate's, so that its phase is too, (n, channels).
        """
        progress = gate_ticks / period_ticks
        jumps = broken * self._random.random(progress.shape)
        ends = self._phase + np.cumsum(jumps + progress, axis=0)
        starts = np.vstack([self._phase, ends[:-1]]) + jumps
        before, after = np.floor(starts), np.floor(ends)
        # A sum in two orders may differ in its last bit: a jump never takes the start beyond the end.
        n = np.maximum(after - before, 0.0)
        first_edge = (self._strides + before.astype(np.int64) + 1) * self._stride_edges
        self._strides = self._strides + after[-1].astype(np.int64)
        self._phase = ends[-1] - after[-1]

        heard = n > 0
        period = np.where(heard, period_ticks, 0.0)
        first = np.where(heard, before + 1.0 - starts, 0.0) * period  # true time of the first stamp in its gate
        noise = self._random.standard_normal((5, *n.shape))
        first_stamp = np.rint(first + jitter_ticks * noise[0])
        last_stamp = np.rint(first + (n - 1.0) * period + jitter_ticks * noise[1])
        first_error = first_stamp - first
        last_error = last_stamp - first - (n - 1.0) * period

        # The stamps between first and last: sum e_k, and sum k e_k split into the part that goes with it and the rest.
        between = np.maximum(n - 2.0, 0.0)
        middle = (n - 1.0) / 2.0
        variance = jitter_ticks**2 + _ROUNDING_VARIANCE
        errors = np.sqrt(variance * between) * noise[2]
        spread = np.sqrt(variance * between * np.maximum(between**2 - 1.0, 0.0) / 12.0) * noise[3]
        sum_of_k = n * (n - 1.0) / 2.0
        sum_of_k2 = sum_of_k * (2.0 * n - 1.0) / 3.0
        s1 = period * sum_of_k + errors + first_error + last_error - n * first_error
        s2 = period * sum_of_k2 + middle * errors + spread + (n - 1.0) * last_error - sum_of_k * first_error

        # Second differences of white errors: variance 6, covariances -4 and 1 with their neighbours.
        # Their sum of squares has the variance 2 (6^2 + 2 4^2 + 2 1^2) for each, as normal errors have it.
        q2 = variance * (6.0 * between + np.sqrt(140.0 * between) * noise[4])

        gate_starts = board_ticks + gate_ticks * np.arange(len(n), dtype=np.int64)[:, np.newaxis]

        def whole(value: npt.NDArray[np.generic]) -> IntegerArray:
            return np.where(heard, np.rint(value), 0).astype(np.int64)

        return StampSums(
            first_edge=np.where(heard, first_edge, 0),
            first_ticks=np.where(heard, gate_starts + first_stamp.astype(np.int64), 0),
            stamps=n.astype(np.int64),
            span_ticks=whole(last_stamp - first_stamp),
            s1_ticks=whole(s1),
            s2_ticks=whole(s2),
            q2_ticks2=whole(np.maximum(q2, 0.0)),
        )
