"""The emulator's truth file, followed while it grows, and looked up by the board's clock."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from simulators.contact import pixel_tractions, point_tractions
from simulators.scenario import FRICTION_COEFFICIENT
from simulators.skin_plate import RADIUS_M_AT_1_NEWTON


@dataclass(frozen=True, slots=True)
class TruthLine:
    """What was true during one gate that ended at `t_ns`, UTC."""

    sequence: int
    board_ticks: int
    t_ns: int
    contacts: tuple[dict[str, Any], ...]

    @property
    def net_force_newton(self) -> NDArray[np.float64]:
        """(3,)."""
        forces = np.array([contact["force_newton"] for contact in self.contacts], np.float64)
        return np.asarray(forces.reshape(-1, 3).sum(axis=0))


class TruthTable:
    """All lines so far, by the tick count at the end of their gates."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: TextIO | None = None
        self._rest = ""
        self.lines: list[TruthLine] = []
        self._index: dict[int, int] = {}

    def read_on(self) -> None:
        """Take what the emulator has written since the last call."""
        if self._file is None:
            if not self._path.exists():
                return
            self._file = self._path.open()
        *whole, self._rest = (self._rest + self._file.read()).split("\n")
        for text in whole:
            line = json.loads(text)
            truth = TruthLine(line["sequence"], line["board_ticks"], int(line["t_ns"]), tuple(line["contacts"]))
            self._index[truth.board_ticks] = len(self.lines)
            self.lines.append(truth)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def window(self, board_ticks: int, frames: int) -> list[TruthLine] | None:
        """Return the lines of the `frames` gates of which the last ended at `board_ticks`; None if not there yet."""
        last = self._index.get(board_ticks)
        if last is None or last + 1 < frames:
            return None
        return self.lines[last + 1 - frames : last + 1]


def surface_traction(line: TruthLine, shape: tuple[int, int], pitch_m: float) -> NDArray[np.float64]:
    """Return the traction (3, ny, nx) that the line's contacts exert, averaged over each pixel."""
    traction = np.zeros((3, *shape))
    for contact in line.contacts:
        traction += pixel_tractions(
            contact["force_newton"],
            contact["position_m"],
            RADIUS_M_AT_1_NEWTON,
            FRICTION_COEFFICIENT,
            shape,
            pitch_m,
        )
    return traction


def site_traction(line: TruthLine, positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the traction (3, n) that the line's contacts exert at points (n, 2) of the surface."""
    traction = np.zeros((3, len(positions_m)))
    for contact in line.contacts:
        traction += point_tractions(
            contact["force_newton"], contact["position_m"], RADIUS_M_AT_1_NEWTON, FRICTION_COEFFICIENT, positions_m
        )
    return traction
