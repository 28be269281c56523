"""Separable bases of fields on a regular grid: products of vectors along x and along y, those that carry the estimate.

Each axis keeps the even and odd vectors that the estimate uses: the leading eigenvectors of its power's marginal. Of
the products of both axes' vectors those stay that carry the estimate.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from resonator_daemon.base.arrays import Floats, Indices
from resonator_daemon.estimate.surface.layout import Grid
from resonator_daemon.estimate.surface.open_plane.estimate_power import (
    CLASSES,
    AxisPower,
    frequencies,
    parities,
    unfold,
)
from resonator_daemon.estimate.surface.open_plane.prior_tables import Field

_FEWEST = 150  # products of a class: fewer save no time
# Parts of what may be left out that each axis' vectors may lose, before the products are chosen.
_AXIS_PART: dict[Field, float] = {"sensor": 0.1, "traction": 0.2, "displacement": 0.2}


class Bases:
    """Even and odd vectors along both axes, as many of each, and the products of them that each class keeps.

    Parameters
    ----------
    grid
    field
    along_x, along_y
        Power of the estimate, see `EstimatePower.by_channel`.
    loss
        Share of it that may be lost.

    Attributes
    ----------
    x, y
        Vectors as columns of (sites of the axis, 2 k), even ones first.
    places
        Of what each class keeps, in (2 kx, 3, 2 ky): two plain products lead there and back. (4, kept).
    """

    def __init__(self, grid: Grid, field: Field, along_x: AxisPower, along_y: AxisPower, loss: float) -> None:
        self.field: Field = field
        power = along_x, along_y
        vectors = [
            _leading(count, along, _AXIS_PART[field] * loss)
            for count, along in zip(grid.shape[::-1], power, strict=True)
        ]
        self.x, self.y = (np.hstack(both) for both in vectors)
        kx, ky = vectors[0][0].shape[1], vectors[1][0].shape[1]
        carried = np.array(
            [
                [
                    np.maximum(
                        _carried(vectors[0][x], power[0][channel][x], vectors[1][y]).T,
                        _carried(vectors[1][y], power[1][channel][y], vectors[0][x]),
                    )
                    for channel, (x, y) in enumerate(parities(field, parity))
                ]
                for parity in CLASSES
            ]
        ).reshape(len(CLASSES), -1)
        ranks = np.argsort(-carried, axis=1, kind="stable")
        by_rank = np.take_along_axis(carried, ranks, axis=1).sum(axis=0)
        needed = min(max(_FEWEST, _needed(by_rank, loss)), carried.shape[1])
        kept = np.sort(ranks[:, :needed], axis=1)
        channel, row, column = np.unravel_index(kept, (3, ky, kx))
        odd_x, odd_y = np.array([parities(field, parity) for parity in CLASSES]).transpose(2, 0, 1)
        x = np.take_along_axis(odd_x, channel, axis=1) * kx + column
        y = np.take_along_axis(odd_y, channel, axis=1) * ky + row
        self.places = np.ravel_multi_index((x, channel, y), (2 * kx, 3, 2 * ky))
        self._ends = [np.searchsorted(of_class, np.arange(4) * kx * ky).tolist() for of_class in kept]
        self._rows, self._columns = row, column

    def kept(self, index: int, channel: int) -> tuple[slice, Indices, Indices]:
        """Return which products of a class belong to a channel, and their vectors along y and along x."""
        part = slice(*self._ends[index][channel : channel + 2])
        return part, self._rows[index, part], self._columns[index, part]


class Reduction:
    """Covariances of two fields between the products that their bases keep.

    Parameters
    ----------
    table
        Covariances for all offsets of two sites, (3, 3, 2 ny - 1, 2 nx - 1).
    rows, columns
        Of the fields.
    """

    def __init__(self, table: Floats, rows: Bases, columns: Bases) -> None:
        self._table = table
        self._rows, self._columns = rows, columns
        self._along_x, self._along_y = (
            [
                [_lag_products(row, column) for column in np.split(of_columns, 2, axis=1)]
                for row in np.split(of_rows, 2, axis=1)
            ]
            for of_rows, of_columns in ((rows.x, columns.x), (rows.y, columns.y))
        )

    def block(self, index: int) -> Floats:
        """Of a class, (kept rows, kept columns)."""
        found = np.empty((self._rows.places.shape[1], self._columns.places.shape[1]))
        odd_rows, odd_columns = (parities(bases.field, CLASSES[index]) for bases in (self._rows, self._columns))
        for row_channel, (row_x, row_y) in enumerate(odd_rows):
            rows, *of_row = self._rows.kept(index, row_channel)
            for column_channel, (column_x, column_y) in enumerate(odd_columns):
                columns, *of_column = self._columns.kept(index, column_channel)
                along_x, along_y = self._along_x[row_x][column_x], self._along_y[row_y][column_y]
                wide = self._table[row_channel, column_channel] @ along_x.reshape(len(along_x), -1)
                products = along_y.reshape(len(along_y), -1).T @ wide
                shape = (*along_y.shape[1:], *along_x.shape[1:])  # rows y, columns y, rows x, columns x
                row_places = np.ravel_multi_index((of_row[0], 0 * of_row[0], of_row[1], 0 * of_row[0]), shape)
                column_places = np.ravel_multi_index(
                    (0 * of_column[0], of_column[0], 0 * of_column[0], of_column[1]), shape
                )
                found[rows, columns] = products.ravel().take(row_places[:, None] + column_places)
        return found


def _lag_products(rows: Floats, columns: Floats) -> Floats:
    """Return sums of r(y) c(y - lag) over y for lags 1 - n .. n - 1, from (n, k) and (n, l): (2 n - 1, k, l)."""
    count = len(rows)
    padded = np.zeros((3 * count - 2, columns.shape[1]))
    padded[count - 1 : 2 * count - 1] = columns
    windows = sliding_window_view(padded, count, axis=0)[::-1]  # (2 n - 1, l, n)
    return np.ascontiguousarray((windows @ rows).swapaxes(1, 2))


def _leading(count: int, power: AxisPower, loss: float) -> list[Floats]:
    """Leading even and odd vectors (count, k), as many of each as the one in need of more needs; 0 beyond the last."""
    found = [np.linalg.eigh(sum(channel[odd].sum(axis=0) for channel in power)) for odd in (0, 1)]
    needed = max(_needed(values[::-1], loss) for values, _ in found)
    leading = np.zeros((2, count, needed))
    for odd, (_, vectors) in enumerate(found):
        kept = vectors[:, ::-1][:, :needed]
        leading[odd, :, : kept.shape[1]] = unfold(count, odd) @ kept
    return list(leading)


def _carried(along: Floats, power: Floats, across: Floats) -> Floats:
    """Power that products of vectors along and across an axis carry, (along, across)."""
    folded = np.sqrt(2.0) * along[: power.shape[1]]
    folded[-1] /= np.sqrt(2.0) if 2 * power.shape[1] > len(along) else 1.0
    of_wave = np.einsum("hk,whg,gk->kw", folded, power, folded, optimize=True)
    waves = np.exp(-1j * np.outer(frequencies(len(across)), np.arange(len(across))))
    return np.asarray(of_wave @ np.abs(waves @ across) ** 2 / len(across), np.float64)


def _needed(power: Floats, loss: float) -> int:
    """Count the leading entries after which no more than a share of the sum is left."""
    rest = power.sum() - np.cumsum(power)
    return int(np.argmax(rest <= loss * power.sum())) + 1
