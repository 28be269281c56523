"""Maps of a plate in characters, x to the right and y downwards: sites with forces, tractions in colours."""

import math
from collections.abc import Iterator, Sequence
from functools import cache, lru_cache
from itertools import chain
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.segment import Segment
from rich.style import Style
from scipy.spatial import cKDTree

Line = list[Segment]
Point = tuple[float, float]

OUTSIDE_PASCAL: Final = -math.inf  # of a pixel that is not on the plate

# Viridis: perceptually uniform, its lightness rises all the way, and safe for the colour-blind.
_VIRIDIS: Final = (
    *((68, 1, 84), (71, 45, 123), (59, 82, 139), (44, 114, 142), (33, 145, 140)),
    *((40, 174, 128), (94, 201, 98), (173, 220, 48), (253, 231, 37)),
)
_LEVELS: Final = 64
_UNKNOWN: Final = -1
_OUTSIDE: Final = -2
_PLAIN: Final = Style()
_TOUCHED: Final = Style(bold=True, reverse=True)
_DENSITY: Final = " .:-=+*#%@"
_BARS: Final = "▁▂▃▄▅▆▇█"

_SITE_PIXELS: Final = 32  # along the longer side
_NO_SITE: Final = -1


class SiteMark(NamedTuple):
    """A site on the map; forces None where nothing touches, NaN where a touch has no known force."""

    position_m: Point
    label: str
    measured_newton: float | None
    true_newton: float | None


def site_map(
    outline_m: tuple[Point, ...], marks: Sequence[SiteMark], force_max_newton: float, rows: int, columns_max: int
) -> list[Line]:
    """Draw a plate's outline and its sites; left of a touched site stands a bar of the measured force, right the true.

    Bars go as the square root of the force, so that light touches are visible next to heavy ones. "?" is unknown.
    A mark with an empty label is a touch that is on no site.
    """
    canvas = _Canvas(outline_m, rows, columns_max)
    for mark in sorted(marks, key=_is_touched, reverse=True):  # untouched ones take the room that is left
        if _is_touched(mark):
            measured, true = (_bar(force, force_max_newton) for force in (mark.measured_newton, mark.true_newton))
            canvas.write(mark.position_m, f"{measured}{mark.label or 'x'}{true}", _TOUCHED)
        elif canvas.has_room(mark.position_m, mark.label, margin=1):
            canvas.write(mark.position_m, mark.label, _PLAIN)
        elif canvas.has_room(mark.position_m, "o", margin=0):
            canvas.write(mark.position_m, "o", _PLAIN)
    return canvas.lines()


def _is_touched(mark: SiteMark) -> bool:
    return (mark.measured_newton, mark.true_newton) != (None, None)


def _bar(force_newton: float | None, force_max_newton: float) -> str:
    if force_newton is None:
        return " "
    if math.isnan(force_newton):
        return "?"
    return _BARS[min(int(math.sqrt(max(force_newton, 0.0) / force_max_newton) * len(_BARS)), len(_BARS) - 1)]


class _Canvas:
    """Characters over the box around an outline, one more on each side; cells are twice as high as they are wide."""

    def __init__(self, outline_m: tuple[Point, ...], rows: int, columns_max: int) -> None:
        self._low = np.min(outline_m, axis=0)
        self._size = np.maximum(np.max(outline_m, axis=0) - self._low, 1e-9)
        self._rows = max(rows - 2, 1)
        self._columns = round(2 * self._rows * self._size[0] / self._size[1])
        if self._columns > columns_max - 2:
            self._columns = max(columns_max - 2, 1)
            self._rows = max(round(self._columns * self._size[1] / self._size[0] / 2), 1)
        border = _border(outline_m, self._rows, self._columns)
        self._cells = [["·" if dot else " " for dot in row] for row in border]
        self._styles = [[_PLAIN] * (self._columns + 2) for _ in border]

    def has_room(self, position_m: Point, text: str, margin: int) -> bool:
        row, first = self._place(position_m, text)
        return not "".join(self._cells[row][max(first - margin, 0) : first + len(text) + margin]).strip(" ·")

    def write(self, position_m: Point, text: str, style: Style) -> None:
        """Write with the middle of the text, or the character left of the middle, at the position."""
        row, first = self._place(position_m, text)
        for column, character in enumerate(text, first):
            if 0 <= column < self._columns + 2 and character != " ":
                self._cells[row][column] = character
                self._styles[row][column] = style

    def _place(self, position_m: Point, text: str) -> tuple[int, int]:
        x, y = (np.asarray(position_m) - self._low) / self._size
        row = 1 + min(max(math.floor(y * self._rows), 0), self._rows - 1)
        middle = 1 + min(max(math.floor(x * self._columns), 0), self._columns - 1)
        return row, middle - (len(text) - 1) // 2

    def lines(self) -> list[Line]:
        return [
            list(Segment.simplify(Segment(character, style) for character, style in zip(cells, styles, strict=True)))
            for cells, styles in zip(self._cells, self._styles, strict=True)
        ]


@lru_cache(maxsize=16)
def _border(outline_m: tuple[Point, ...], rows: int, columns: int) -> NDArray[np.bool_]:
    """Return which of (rows + 2, columns + 2) cells, the top row first, lie outside the outline and next to it."""
    (x0, y0), (x1, y1) = np.min(outline_m, axis=0), np.max(outline_m, axis=0)
    x = x0 + (x1 - x0) * (np.arange(-1, columns + 1) + 0.5) / columns
    y = (y0 + (y1 - y0) * (np.arange(-1, rows + 1) + 0.5) / rows)[:, np.newaxis]
    inside = inside_outline(outline_m, x, y)
    around = np.pad(inside, 1)
    near = np.zeros_like(inside)
    for down in range(3):
        for right in range(3):
            near |= around[down : down + rows + 2, right : right + columns + 2]
    return near & ~inside


def inside_outline(outline_m: tuple[Point, ...], x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return whether each place, x and y broadcast, lies within a polygon."""
    inside = np.zeros(np.broadcast_shapes(x.shape, y.shape), np.bool_)
    for (xa, ya), (xb, yb) in zip(outline_m, (*outline_m[1:], outline_m[0]), strict=True):
        if ya != yb:  # even-odd rule: a ray to the right crosses the edge
            inside ^= ((ya > y) != (yb > y)) & (x < xa + (y - ya) * (xb - xa) / (yb - ya))
    return inside


def pooling(shape: tuple[int, int], rows: int, columns: int) -> int:
    """Return how many pixels (ny, nx) must share one, each way, so that a traction map fits; two fit into a row."""
    ny, nx = shape
    return max(math.ceil(ny / (2 * rows)), math.ceil(nx / columns), 1)


def traction_map(traction_pascal: NDArray[np.floating], full_pascal: float, pool: int, *, colours: bool) -> list[Line]:
    """Draw a traction (ny, nx), two pixels in a character: from 0, dark, to the full value; "?" is unknown.

    Row 0 is on top. Without colours characters that are more and more dense take their place. Pixels outside the
    plate stay empty.
    """
    pooled = _pooled(np.asarray(traction_pascal, np.float64), pool)
    if len(pooled) % 2:
        pooled = np.vstack([pooled, np.full((1, pooled.shape[1]), OUTSIDE_PASCAL)])
    with np.errstate(invalid="ignore"):
        scaled = np.clip(np.nan_to_num(pooled / full_pascal, nan=0.0), 0.0, 1.0)
    levels = np.rint(scaled * (_LEVELS - 1)).astype(int)
    levels[np.isnan(pooled)] = _UNKNOWN
    levels[pooled == OUTSIDE_PASCAL] = _OUTSIDE
    cell = _coloured if colours else _dense
    pairs = zip(levels[::2].tolist(), levels[1::2].tolist(), strict=True)
    return [list(Segment.simplify(map(cell, upper, lower))) for upper, lower in pairs]


def scale_bar(columns: int, *, colours: bool) -> Line:
    """Draw what the map's colours are, from 0 to the full value."""
    levels = [round(column * (_LEVELS - 1) / max(columns - 1, 1)) for column in range(columns)]
    cell = _coloured if colours else _dense
    return [cell(level, level) for level in levels]


def round_scale(value: float) -> float:
    """Return the next of 1, 2, 5, 10, ... above a value, so that a scale does not flicker; 1 for what is no scale."""
    if not 0 < value < math.inf:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(value))
    return next(step * decade for step in (1, 2, 5, 10) if step * decade >= value * (1 - 1e-9))


def side_by_side(columns: Sequence[tuple[int, Sequence[Line]]]) -> Iterator[Segment]:
    """Put blocks of lines, each with its width, next to each other."""
    for row in range(max(len(lines) for _, lines in columns)):
        blocks = (Segment.adjust_line_length(lines[row] if row < len(lines) else [], n) for n, lines in columns)
        yield from chain.from_iterable(blocks)
        yield Segment.line()


def _pooled(values: NDArray[np.float64], pool: int) -> NDArray[np.float64]:
    """Return means over squares of pixels, over those there are at the far edges; unknown where one is."""
    ny, nx = values.shape
    rows, columns = np.arange(0, ny, pool), np.arange(0, nx, pool)
    sums = np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)
    counts = np.outer(np.diff([*rows, ny]), np.diff([*columns, nx]))
    return np.asarray(sums / counts)


@cache
def _coloured(upper: int, lower: int) -> Segment:
    if _UNKNOWN in (upper, lower):
        return Segment("?", _PLAIN)
    if upper == lower == _OUTSIDE:
        return Segment(" ", _PLAIN)
    if upper == _OUTSIDE:
        return Segment("▄", Style.from_color(_colour(lower)))
    if lower == _OUTSIDE:
        return Segment("▀", Style.from_color(_colour(upper)))
    return Segment("▀", Style.from_color(_colour(upper), _colour(lower)))


@cache
def _dense(upper: int, lower: int) -> Segment:
    if _UNKNOWN in (upper, lower):
        return Segment("?", _PLAIN)
    level = (max(upper, 0) + max(lower, 0)) / 2
    return Segment(_DENSITY[round(level * (len(_DENSITY) - 1) / (_LEVELS - 1))], _PLAIN)


def _colour(level: int) -> Color:
    place = level / (_LEVELS - 1) * (len(_VIRIDIS) - 1)
    low = min(int(place), len(_VIRIDIS) - 2)
    (r, g, b) = ((1 - place + low) * a + (place - low) * z for a, z in zip(*_VIRIDIS[low : low + 2], strict=True))
    return Color.from_rgb(r, g, b)


def as_pixels(
    values_pascal: NDArray[np.floating], outline_m: tuple[Point, ...], positions_m: tuple[Point, ...]
) -> NDArray[np.float64]:
    """Return values (n,) at positions (n, 2) as (ny, nx), row 0 at the least y, for `traction_map`."""
    nearest = _nearest_sites(outline_m, positions_m)
    return np.where(nearest == _NO_SITE, OUTSIDE_PASCAL, np.asarray(values_pascal, np.float64)[nearest])


@lru_cache(maxsize=16)
def _nearest_sites(outline_m: tuple[Point, ...], positions_m: tuple[Point, ...]) -> NDArray[np.intp]:
    low, high = np.min(outline_m, axis=0), np.max(outline_m, axis=0)
    pitch_m = float(np.max(high - low)) / _SITE_PIXELS
    nx, ny = np.ceil((high - low) / pitch_m - 1e-6).astype(int)
    x, y = np.meshgrid(
        (low[0] + high[0]) / 2 + (np.arange(nx) - (nx - 1) / 2) * pitch_m,
        (low[1] + high[1]) / 2 + (np.arange(ny) - (ny - 1) / 2) * pitch_m,
    )
    _, nearest = cKDTree(np.array(positions_m)).query(np.stack([x, y], axis=-1))
    return np.where(inside_outline(outline_m, x, y), nearest, _NO_SITE)
