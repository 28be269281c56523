"""One window of a single-tone counter: frequencies, sums and faults of its channels."""

from collections.abc import Sequence

from resonator_daemon.estimate.tones.frequency_estimators import Sums
from resonator_daemon.estimate.tones.gate_block import GateBlock, WindowSums


class CountedWindow:
    """What the channels have counted in the last gates of a block, up to one of them."""

    def __init__(self, block: GateBlock, gate: int, frames: int, sums: WindowSums, index: int) -> None:
        self.frames = frames
        self.held = block.held[gate]
        self.crowded: Sequence[int] = ()
        self._block, self._gate = block, gate
        self._sums, self._index = sums, index

    @property
    def frequency_hz(self) -> list[float]:
        return self._sums.frequency_hz(self._index)

    @property
    def sums(self) -> list[Sums | None]:
        return self._sums.sums(self._index)

    @property
    def gates(self) -> tuple[list[list[float]], list[list[float]]]:
        return self._block.last(self._gate, self.frames)

    @property
    def faults(self) -> list[str | None]:
        return self._block.fault_names(self._gate)

    @property
    def attenuation_db(self) -> list[float]:
        return self._block.attenuation_db(self._gate)
