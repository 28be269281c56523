"""The sliding window of one channel: its last gates, for as long as the same tone's stamps run on."""

import math
from collections import deque
from itertools import islice
from typing import Final

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.measurement.counting import FREQUENCY_JUMP, Sums, continues, merge_adjacent
from resonator_daemon.measurement.record_faults import Gate, read_gate

_STRIDE_BREAK: Final = int(RecordFlag.STRIDE_BREAK)


class SlidingWindow:
    """The last `frames` gates of one channel, for as long as the same tone's stamps run on without a break.

    Attributes
    ----------
    held
        How many gates are held.
    fault
        Why the last record was not usable; None where it was, or after a gap.
    """

    def __init__(self, frames: int, reference_hz: float, band_hz: tuple[float, float]) -> None:
        """`band_hz` is the lowest and the highest frequency that the plate could ever send."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        self._gates: deque[Gate] = deque(maxlen=frames)
        self._reference_hz = reference_hz
        self._lowest_hz, self._highest_hz = band_hz
        self.fault: str | None = None
        self.held = 0

    def restart(self) -> None:
        """Forget everything, as after a gap."""
        self._empty(None)

    def resize(self, frames: int) -> None:
        """Hold so many gates from here; of those held now the newest stay."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        self._gates = deque(self._gates, maxlen=frames)
        self.held = len(self._gates)

    def push(self, record: SingleToneRecord) -> str | None:
        """Take one gate's record; returns why it is not usable, else None.

        An unusable record empties the window; one that does not run on from the last starts it anew.
        """
        gates = self._gates
        gate = read_gate(record, self._reference_hz)
        if isinstance(gate, str):
            return self._empty(gate)
        sums, gate_hz, _ = gate
        if not self._lowest_hz <= gate_hz <= self._highest_hz:
            return self._empty("impossible_frequency")
        self.fault = None
        if gates:
            last_sums, last_hz, _ = gates[-1]
            if (
                record.flags & _STRIDE_BREAK
                or abs(gate_hz - last_hz) > FREQUENCY_JUMP * gate_hz
                or not continues(last_sums, sums)
            ):
                gates.clear()
        gates.append(gate)
        self.held = len(gates)
        return None

    def _empty(self, fault: str | None) -> str | None:
        self._gates.clear()
        self.held = 0
        self.fault = fault
        return fault

    @property
    def full(self) -> bool:
        return self.held == self._gates.maxlen

    @property
    def last_hz(self) -> float:
        """Frequency of the last gate, by its own regression; NaN where none is held."""
        return self._gates[-1].frequency_hz if self._gates else math.nan

    @property
    def gates(self) -> tuple[Gate, ...]:
        """The gates held, oldest first; fewer than `frames` until the window is full."""
        return tuple(self._gates)

    def sums(self, frames: int | None = None) -> Sums | None:
        """Add up the last `frames` gates, or the whole window; None until that many are held.

        Raises ValueError where the window never holds that many.
        """
        most = self._gates.maxlen or 0
        wanted = most if frames is None else frames
        if not 1 <= wanted <= most:
            raise ValueError(f"sums of {wanted} frames, the window has 1 to {most}")
        if self.held < wanted:
            return None
        return merge_adjacent([gate.sums for gate in islice(self._gates, self.held - wanted, None)])
