"""Parity of a regular grid: both mirror symmetries split every covariance into four blocks that do not mix.

In a class (a, b), f_z and p_n have parity a along x and b along y (0 even, 1 odd), f_x, u_x and eps_xz have (1 - a, b),
f_y, u_y and eps_yz (a, 1 - b). Even and odd vectors of an axis are named by the values at its first half, times sqrt 2
but for a site on the mirror itself, so that they stay orthonormal.
"""

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.layout import Grid
from resonator_daemon.estimate.surface.open_plane.prior_tables import Field, StationaryPrior

Parity = tuple[int, int]  # along x, along y

CLASSES: tuple[Parity, ...] = ((0, 0), (0, 1), (1, 0), (1, 1))

# What a mirror along x or y does to each channel beyond what it does to p_n and f_z.
_FLIPS: dict[Field, tuple[Parity, ...]] = {
    "sensor": ((0, 0), (1, 0), (0, 1)),
    "traction": ((1, 0), (0, 1), (0, 0)),
    "displacement": ((1, 0), (0, 1), (0, 0)),
}


def parities(field: Field, parity: Parity) -> list[Parity]:
    """Parity of each of the three channels of a field in a class."""
    return [((parity[0] + x) % 2, (parity[1] + y) % 2) for x, y in _FLIPS[field]]


def half(count: int, odd: int) -> int:
    """Count the even or odd vectors of an axis of `count` sites."""
    return (count + 1 - odd) // 2


def unfold(count: int, odd: int) -> Floats:
    """Even or odd orthonormal vectors of an axis as columns, (count, half)."""
    matrix = np.zeros((count, half(count, odd)))
    for column in range(matrix.shape[1]):
        matrix[column, column] += 1.0
        matrix[count - 1 - column, column] += -1.0 if odd else 1.0
    unit: Floats = matrix / np.linalg.norm(matrix, axis=0)
    return unit


def offset_table(
    grid: Grid, prior: StationaryPrior, row: Field, row_depth_m: float, column: Field, depth_m: float
) -> Floats:
    """Return the covariances for all offsets of two sites, (3, 3, 2 ny - 1, 2 nx - 1)."""
    ny, nx = grid.shape
    x = np.arange(1 - nx, nx) * grid.pitch_x_m
    y = np.arange(1 - ny, ny) * grid.pitch_y_m
    kernel = prior.kernel(row, row_depth_m, column, depth_m, float(np.hypot(x[-1], y[-1])))
    return kernel(np.stack(np.meshgrid(x, y), axis=-1)).transpose(2, 3, 0, 1)


def fold(table: Floats, count: int, row_odd: int, column_odd: int) -> Floats:
    """Replace the last axis of offsets, 2 count - 1 long, by two axes of even or odd vectors.

    Mirrored rows only repeat the first half; mirrored columns add.
    """
    rows = np.arange(half(count, row_odd))
    columns = np.arange(half(count, column_odd))
    near = rows[:, None] - columns + count - 1
    far = rows[:, None] - (count - 1 - columns) + count - 1
    sign = -1.0 if column_odd else 1.0
    norm = np.ones_like(near, np.float64)
    norm[2 * rows == count - 1, :] /= np.sqrt(2.0)
    norm[:, 2 * columns == count - 1] /= np.sqrt(2.0)
    return np.asarray((table[..., near] + sign * table[..., far]) * norm, np.float64)
