"""Counts of one channel that never wrap: edges and ticks of stamps as integers of any size, frequency over any time.

The board's time, 64 bits wide, determines how often the tick counter has wrapped. How often the edge counter has, also
across frames that are lost, follows from the last gate's frequency. A step that neither explains starts the counts
again, and no frequency spans it. What a channel counted in lost frames is not known: edges across them are all that
were counted.
"""

import math
from collections import Counter
from typing import Final, NamedTuple

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.tones.frequency_estimators import FREQUENCY_JUMP, WRAP_MASK, Sums, stamp_std_ticks

NOISE_SIGMAS: Final = 6.0
FREQUENCY_SPAN: Final = 200e-6  # in any time a tone moves by less; half the way to the next code
WHOLE_EDGE: Final = 0.5  # counts are whole: more than half an edge off is another count
DOUBT_EDGES: Final = 1 << 22  # with more in doubt, one in 500 broken counts would pass for a sound one

_STRIDE_BREAK: Final = int(RecordFlag.STRIDE_BREAK)


class Stamp(NamedTuple):
    """Index of an edge and the tick of its time stamp, neither of which wraps."""

    edge: int
    ticks: int


def frequency_between_hz(earlier: Stamp, later: Stamp, reference_hz: float) -> float:
    """Frequency of the edges from two stamps between which an `Unwrapper` has not restarted (Pi)."""
    if later.ticks <= earlier.ticks:
        raise ValueError(f"later stamp at tick {later.ticks}, the earlier one at {earlier.ticks}")
    return reference_hz * ((later.edge - earlier.edge) / (later.ticks - earlier.ticks))


class Unwrapper:
    """Stamps of one channel: `first` since the last resync and `last`, None while there is none."""

    def __init__(self) -> None:
        self.first: Stamp | None = None
        self.last: Stamp | None = None
        self.resyncs: Counter[str] = Counter()  # by cause
        self._gate: Sums | None = None

    def restart(self, cause: str) -> None:
        """Discard all stamps, as after a fault or a restart of the board; counts `cause`."""
        if self._gate is not None:
            self.resyncs[cause] += 1
        self.first = self.last = self._gate = None

    def push(self, board_ticks: int, record: SingleToneRecord) -> str | None:
        """Append a record without fault, and the unwrapped board time at the end of its gate.

        Returns None where it goes on from the one before or is the first, else why the counts restart with it:
        "stride_break", "ticks_implausible", "edges_implausible", or "gap_too_long" after so many lost frames that the
        wraps of the edge counter are in doubt, half an hour at 10 MHz.
        """
        gate = Sums.of(record)
        ticks = board_ticks - ((board_ticks - gate.first_ticks) & WRAP_MASK)
        edge = gate.first_edge
        cause = None
        if self._gate is not None and self.last is not None:
            passed = ticks - self.last.ticks
            advance = _advance_edges(self._gate, passed, gate.first_edge - self.last.edge)
            if record.flags & _STRIDE_BREAK:
                cause = "stride_break"
            elif passed <= 0 or ticks + gate.span_ticks - board_ticks > gate.span_ticks // (gate.stamps - 1):
                cause = "ticks_implausible"
            else:
                cause = _advance_fault(self._gate, passed, advance)
            if cause is None:
                edge = self.last.edge + advance
            else:
                self.restart(cause)
        self.first = self.first or Stamp(edge, ticks)
        self.last = Stamp(edge + _edges(gate), ticks + gate.span_ticks)
        self._gate = gate
        return cause


def _edges(gate: Sums) -> int:
    return (gate.stamps - 1) * gate.stride_edges


def _advance_edges(gate: Sums, passed_ticks: int, counted: int) -> int:
    """Edges since the last stamp: `counted` modulo a wrap, and as many wraps as `gate`'s frequency makes likely."""
    lowest = _edges(gate) * passed_ticks // gate.span_ticks - WRAP_MASK // 2
    return lowest + ((counted - lowest) & WRAP_MASK)


def _advance_fault(gate: Sums, passed_ticks: int, advance: int) -> str | None:
    """Return why no tone in `gate` makes `advance` edges in the ticks since its last stamp; None if it may."""
    edges, span = _edges(gate), gate.span_ticks
    gates = 1 + passed_ticks / span
    drift_edges = min(FREQUENCY_JUMP * gates, FREQUENCY_SPAN) * passed_ticks * edges / span
    noise_edges = NOISE_SIGMAS * math.sqrt(2.0) * stamp_std_ticks(gate) * gates * edges / span
    tolerance_edges = WHOLE_EDGE + drift_edges + noise_edges
    if tolerance_edges > DOUBT_EDGES:
        return "gap_too_long"
    return "edges_implausible" if abs(advance * span - edges * passed_ticks) > tolerance_edges * span else None
