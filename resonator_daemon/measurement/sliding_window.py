"""The sliding window of one channel: its last gates, for as long as the same tone's stamps run on."""

from collections import deque
from itertools import islice
from typing import Final

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.measurement.counting import FREQUENCY_JUMP, Sums, continues, frequency_hz, merge
from resonator_daemon.measurement.other_tones import end_residual_ticks2
from resonator_daemon.measurement.record_faults import fault

_STRIDE_BREAK: Final = int(RecordFlag.STRIDE_BREAK)


class SlidingWindow:
    """The last `frames` gates of one channel, for as long as the same tone's stamps run on without a break."""

    def __init__(self, frames: int, reference_hz: float, band_hz: tuple[float, float]) -> None:
        """`band_hz` is the lowest and the highest frequency that the plate could ever send."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        self._parts: deque[Sums] = deque(maxlen=frames)
        self._gate_hz: deque[float] = deque(maxlen=frames)
        self._residual_ticks2: deque[float] = deque(maxlen=frames)
        self._reference_hz = reference_hz
        self._lowest_hz, self._highest_hz = band_hz
        self.fault: str | None = None

    def restart(self) -> None:
        """Forget everything, as after a gap."""
        self._clear()
        self.fault = None

    def resize(self, frames: int) -> None:
        """Hold so many gates from here; of those held now the newest stay."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        self._parts = deque(self._parts, maxlen=frames)
        self._gate_hz = deque(self._gate_hz, maxlen=frames)
        self._residual_ticks2 = deque(self._residual_ticks2, maxlen=frames)

    def push(self, record: SingleToneRecord) -> str | None:
        """Take one gate's record; returns why it is not usable, else None.

        An unusable record empties the window; one that does not run on from the last starts it anew.
        """
        self.fault = fault(record)
        if self.fault is not None:
            self._clear()
            return self.fault
        part = Sums.of(record)
        gate_hz = frequency_hz(part, self._reference_hz)
        if not self._lowest_hz <= gate_hz <= self._highest_hz:
            self._clear()
            self.fault = "impossible_frequency"
            return self.fault
        if self._parts and (
            record.flags & _STRIDE_BREAK
            or abs(gate_hz - self._gate_hz[-1]) > FREQUENCY_JUMP * gate_hz
            or not continues(self._parts[-1], part)
        ):
            self._clear()
        self._parts.append(part)
        self._gate_hz.append(gate_hz)
        self._residual_ticks2.append(end_residual_ticks2(part))
        return None

    def _clear(self) -> None:
        self._parts.clear()
        self._gate_hz.clear()
        self._residual_ticks2.clear()

    @property
    def full(self) -> bool:
        return len(self._parts) == self._parts.maxlen

    @property
    def parts(self) -> tuple[Sums, ...]:
        """Sums of each gate held, oldest first; fewer than `frames` until the window is full."""
        return tuple(self._parts)

    @property
    def gate_hz(self) -> tuple[float, ...]:
        """Frequency of each gate held, by its own regression, oldest first."""
        return tuple(self._gate_hz)

    @property
    def residual_ticks2(self) -> tuple[float, ...]:
        """What the regression line of each gate held leaves of its ends, mean square, oldest first."""
        return tuple(self._residual_ticks2)

    def sums(self, frames: int | None = None) -> Sums | None:
        """Add up the last `frames` gates, or the whole window; None until that many are held.

        Raises ValueError where the window never holds that many.
        """
        most = self._parts.maxlen or 0
        wanted = most if frames is None else frames
        if not 1 <= wanted <= most:
            raise ValueError(f"sums of {wanted} frames, the window has 1 to {most}")
        held = len(self._parts)
        return merge(islice(self._parts, held - wanted, None)) if held >= wanted else None
