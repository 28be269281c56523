"""The emulator's truth file, followed while it grows, and looked up by the board's clock."""

import json
import math
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from simulators.contact import contact_radius_m, pixel_tractions, point_tractions
from simulators.pressing import FRICTION_COEFFICIENT, RADIUS_M_AT_1_NEWTON


class TruthLine(NamedTuple):
    """What was true during one gate that ended at `t_ns`, UTC."""

    sequence: int
    board_ticks: int
    t_ns: int
    contacts: Sequence[dict[str, Any]]

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

    def read_on(self) -> list[TruthLine]:
        """Read the lines that the emulator has written since the last call."""
        if self._file is None:
            if not self._path.exists():
                return []
            self._file = self._path.open()
        whole, _, self._rest = (self._rest + self._file.read()).rpartition("\n")
        new = [
            TruthLine(line["sequence"], line["board_ticks"], int(line["t_ns"]), line["contacts"])
            for line in json.loads("[" + whole.replace("\n", ",") + "]")
        ]
        self._index.update(zip((line.board_ticks for line in new), count(len(self.lines)), strict=False))
        self.lines += new
        return new

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
        rows, columns, centre_m = _pixels_around(contact, shape, pitch_m)
        traction[:, rows, columns] += pixel_tractions(
            contact["force_newton"],
            centre_m,
            RADIUS_M_AT_1_NEWTON,
            FRICTION_COEFFICIENT,
            (rows.stop - rows.start, columns.stop - columns.start),
            pitch_m,
        )
    return traction


def _pixels_around(
    contact: dict[str, Any], shape: tuple[int, int], pitch_m: float
) -> tuple[slice, slice, tuple[float, float]]:
    """Return the rows and columns that a contact reaches, and its centre relative to the centre of these pixels."""
    radius = float(contact_radius_m(contact["force_newton"][2], RADIUS_M_AT_1_NEWTON)) / pitch_m
    slices, centre_m = [], []
    for place_m, size in zip(contact["position_m"], reversed(shape), strict=True):
        place = place_m / pitch_m + size / 2  # in pixels from the edge
        start = min(max(math.floor(place - radius), 0), size)
        stop = min(max(math.ceil(place + radius), start), size)
        slices.append(slice(start, stop))
        centre_m.append((place - (start + stop) / 2) * pitch_m)
    columns, rows = slices
    return rows, columns, (centre_m[0], centre_m[1])


def site_traction(line: TruthLine, positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the traction (3, n) that the line's contacts exert at points (n, 2) of the surface."""
    traction = np.zeros((3, len(positions_m)))
    for contact in line.contacts:
        traction += point_tractions(
            contact["force_newton"], contact["position_m"], RADIUS_M_AT_1_NEWTON, FRICTION_COEFFICIENT, positions_m
        )
    return traction
