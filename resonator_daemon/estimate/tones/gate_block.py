"""Interface of a block of adjacent gates, few or many, and of the windows that end with them."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from resonator_daemon.estimate.tones.frequency_estimators import Sums
from resonator_daemon.estimate.tones.record_checks import FAULTS


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
    """A block of adjacent gates, and the windows that end with each of them.

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
        """Return the fault of each channel of a gate; None where there is none."""
        return [FAULTS[code] for code in self.faults[gate]] if self.faults else [None] * len(self.held[gate])

    def count_faults(self) -> Counter[str]:
        """Count the records that gave no frequency, by cause."""
        return Counter(str(FAULTS[code]) for codes in self.faults for code in codes if code)

    @abstractmethod
    def other_tones(self, pilot_hz: float, tolerance: float) -> list[list[bool]]:
        """Return, by gate and channel, whether a tone is off the pilot by more than this ratio; empty: none is."""

    @abstractmethod
    def attenuation_db(self, gate: int) -> list[float]:
        """Level of each channel below full scale."""

    @abstractmethod
    def last(self, gate: int, frames: int) -> tuple[list[list[float]], list[list[float]]]:
        """Frequencies of the last `frames` gates, and the mean square that their lines leave at their ends, in ticks^2.

        Both by channel; valid for channels that hold so many gates.
        """

    @abstractmethod
    def windows(self, gates: Sequence[int], frames: Sequence[int]) -> WindowSums:
        """Add up windows: `frames[i]` gates that end with `gates[i]`, on each channel."""
