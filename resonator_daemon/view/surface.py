"""A decoded skin: a map of the normal traction, and the forces that it sums up to."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from resonator_daemon.publishing.topics import DECODED, DECODED_SUMMARY
from resonator_daemon.view.maps import Line, pooling, round_scale, scale_bar, traction_map
from resonator_daemon.view.plate_view import PlateView, TrueContact, Truth
from resonator_daemon.view.words import UNKNOWN, newtons, pascals, quantity

Floats = NDArray[np.floating]
Vector3 = tuple[float, float, float]

_GAP: Final = 2
_SCALE_COLUMNS: Final = 10
_NOISE_OF_SCALE: Final = 1 / 8  # how far up the scale the noise of an untouched skin goes
_NOTHING_KNOWN: Final = (math.nan, math.nan, math.nan)
_SHEAR_MIN_NEWTON: Final = 5e-3  # below, noise decides the direction


class SurfacePanel:
    """Draws the last decoded frame of a plate, and its truth unless that is None."""

    def __init__(self, view: PlateView, truth: Truth | None, now_utc_ns: int, *, colours: bool) -> None:
        self._decoded = view.current(DECODED, now_utc_ns)
        self._summary = view.current(DECODED_SUMMARY, now_utc_ns)
        self._truth = truth
        self._colours = colours
        self._maps: dict[str, Floats] = {}
        highest = [0.0]
        if self._decoded is not None and self._decoded.grid is not None:
            self._maps["measured"] = self._decoded.traction_pascal[2]
            highest.append(_max_known(self._decoded.traction_std_pascal[2]) / _NOISE_OF_SCALE)
        if truth is not None and truth.traction_z_pascal is not None:
            self._maps["true"] = truth.traction_z_pascal
        self._full_pascal = round_scale(max(highest + [_max_known(traction) for traction in self._maps.values()]))

    def maps(self, rows: int, columns_max: int) -> list[list[Line]]:
        """Return the measured map and the true one, with a last line that says which it is."""
        columns_each = (columns_max - _GAP * (len(self._maps) - 1)) // max(len(self._maps), 1)
        blocks = []
        for name, traction in self._maps.items():
            ny, nx = traction.shape
            pool = pooling((ny, nx), rows - 1, columns_each)
            lines = traction_map(traction, self._full_pascal, pool, colours=self._colours)
            blocks.append([*lines, [Segment(name.center(Segment.get_line_length(lines[0])))]])
        return blocks

    def text(self) -> list[RenderableType]:
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        table.add_column("over the map")
        forces = {"measured": self._net_newton()}
        if self._truth is not None:
            forces["true"] = _sum_newton(self._truth.contacts)
        for name in forces:
            table.add_column(name, no_wrap=True)
        table.add_row("normal force", *(newtons(z) for _, _, z in forces.values()))
        table.add_row("shear force", *(newtons(math.hypot(x, y)) for x, y, _ in forces.values()))
        table.add_row("  towards", *(_direction(x, y) for x, y, _ in forces.values()))
        parts: list[RenderableType] = [table, Text(self._fit())]
        if self._maps:
            bar = ((cell.text, cell.style or "") for cell in scale_bar(_SCALE_COLUMNS, colours=self._colours))
            parts.append(Text.assemble("f_z 0 ", *bar, f" {pascals(self._full_pascal)}"))
        return parts

    def words(self) -> str:
        """Return the forces in one line."""
        x, y, z = self._net_newton()
        return f"normal force {newtons(z)}, shear force {newtons(math.hypot(x, y))}; {self._fit()}"

    def _fit(self) -> str:
        if self._decoded is None or self._summary is None:
            return "surface unknown: nothing decoded arrives"
        border = "reaches the border, expect errors there" if self._summary.border_contact else "clear of the border"
        chi2 = quantity(self._summary.chi2, ".2f", "")
        return f"status {self._summary.status}, {self._summary.decoder} chi2 {chi2}, {border}"

    def _net_newton(self) -> Vector3:
        """Integrate the traction over the map; NaN where a pixel is unknown."""
        if self._decoded is None or self._decoded.grid is None:
            return _NOTHING_KNOWN
        area_m2 = self._decoded.grid.pitch_m**2
        x, y, z = (area_m2 * float(np.sum(component, dtype=np.float64)) for component in self._decoded.traction_pascal)
        return x, y, z


def _sum_newton(contacts: Sequence[TrueContact]) -> Vector3:
    x, y, z = (math.fsum(contact.force_newton[axis] for contact in contacts) for axis in range(3))
    return x, y, z


def _max_known(values: Floats) -> float:
    return float(np.max(values, initial=0.0, where=np.isfinite(values)))


def _direction(x_newton: float, y_newton: float) -> str:
    if not math.hypot(x_newton, y_newton) >= _SHEAR_MIN_NEWTON:
        return UNKNOWN
    return f"{round(math.degrees(math.atan2(y_newton, x_newton)))}°"
