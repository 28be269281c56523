"""What can be asked of gates that came together, few or many."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from resonator_daemon.measurement.counting import Sums
from resonator_daemon.measurement.record_checks import FAULTS


class WindowSums(Protocol):
    """Sums over some windows."""

    def frequency_hz(self, window: int) -> list[float]:
        """Return the frequencies of a window by channel; NaN where it is not held."""
        ...

    def sums(self, window: int) -> list[Sums | None]:
        """Return the sums of a window by channel; None where it is not held.

        First edge and first tick need not be those of the window.
        """
        ...


class GateBlock(ABC):
    """Gates that came together, and the windows that end with each of them.

    Attributes
    ----------
    held
        By gate and channel: how many gates of the same tone there are, up to the length of the window.
    faults
        By gate and channel, as codes of `FAULTS`; empty where no record has one.
    steady
        All windows were full before, and no tone has changed.
    """

    held: list[list[int]]
    faults: list[list[int]]
    steady: bool

    def __len__(self) -> int:
        return len(self.held)

    def fault_names(self, gate: int) -> list[str | None]:
        """Why each channel of a gate is not usable; None where it is."""
        return [FAULTS[code] for code in self.faults[gate]] if self.faults else [None] * len(self.held[gate])

    def count_faults(self) -> Counter[str]:
        """Count the records that gave no frequency, by cause."""
        return Counter(str(FAULTS[code]) for codes in self.faults for code in codes if code)

    @abstractmethod
    def other_tones(self, pilot_hz: float, tolerance: float) -> list[list[bool]]:
        """Tell by gate and channel which hear a tone that is off the pilot by this, relative; empty: none."""

    @abstractmethod
    def attenuation_db(self, gate: int) -> list[float]:
        """Level of each channel below full scale."""

    @abstractmethod
    def last(self, gate: int, frames: int) -> tuple[list[list[float]], list[list[float]]]:
        """Frequencies of the last `frames` gates, and the mean square that their lines leave at their ends, in ticks^2.

        Both by channel; they tell something where so many gates are held.
        """

    @abstractmethod
    def windows(self, gates: Sequence[int], frames: Sequence[int]) -> WindowSums:
        """Add up windows: `frames[i]` gates that end with `gates[i]`, on each channel."""
