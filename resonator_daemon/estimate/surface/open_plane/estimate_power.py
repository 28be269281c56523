"""Symmetries of a regular grid of sites: parity, and the power that patterns along one axis carry.

Both mirror symmetries split every covariance into four blocks that do not mix. In a class (a, b), f_z and p_n have
parity a along x and b along y (0 even, 1 odd), f_x, u_x and eps_xz have (1 - a, b), f_y, u_y and eps_yz (a, 1 - b).
Even and odd vectors of an axis are named by the values at its first half, times sqrt 2 but for a site on the mirror
itself, so that they stay orthonormal.

Reduced bases have to keep the power of the estimate. Across an axis the grid is taken as endless, so that its modes are
waves there; along the axis it has its true ends. At each frequency across, the signals have a covariance
q V diag(L) V' + 1 and the surface q F V' with them. A mode carries w = q^2 |F v|^2 / (q L + 1) of the estimate's
power.
"""

from typing import Literal

import numpy as np

from resonator_daemon.base.arrays import Complexes, Floats
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

AxisPower = list[list[Floats]]
"""Power matrices between even and between odd vectors of each channel: [channel][odd], (waves across, h, h)."""

FIELDS: tuple[Field, ...] = ("sensor", "traction", "displacement")
_LENGTHS = 2  # of the grid: half the period along the axis
_FADED = 12.0  # frequency times depth beyond which what a grid folds back is negligible
# Which channel points across the axis x, y: its waves are a quarter of a period behind those of the others.
_ACROSS: dict[Field, tuple[int, int]] = {"sensor": (2, 1), "traction": (1, 0), "displacement": (1, 0)}


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
    return np.asarray(matrix / np.linalg.norm(matrix, axis=0), np.float64)


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


class EstimatePower:
    """Power of the estimate along one axis.

    Parameters
    ----------
    prior
        At scale 1.
    grid
    depth_m
    noise_std
        Of each channel, (3,).
    axis
        0 for x, 1 for y.
    """

    def __init__(
        self, prior: StationaryPrior, grid: Grid, depth_m: float, noise_std: Floats, axis: Literal[0, 1]
    ) -> None:
        counts, pitches_m = grid.shape[::-1], (grid.pitch_x_m, grid.pitch_y_m)
        self._count = count = counts[axis]
        periods = (counts[0] * (1 if axis else _LENGTHS), counts[1] * (_LENGTHS if axis else 1))
        x, y = ((frequencies(size) / pitch_m) for size, pitch_m in zip(periods, pitches_m, strict=True))
        self._axis = axis
        tables = {
            field: _lags(_density(prior, grid, depth_m, field, x, y), field, axis, count) / noise_std
            for field in FIELDS
        }
        self._modes = []
        for odd in (0, 1):
            blocks = {field: _folded(table, field, axis, odd, count) for field, table in tables.items()}
            counts_of_channels = [half(count, of_channel) for of_channel in _odd("sensor", axis, odd)]
            std = np.repeat(noise_std, counts_of_channels)[:, None]
            eigenvalues, vectors = np.linalg.eigh(blocks["sensor"] / std)
            surface = {field: block @ vectors for field, block in blocks.items() if field != "sensor"}
            self._modes.append((np.maximum(eigenvalues, 0.0), {"sensor": vectors} | surface))

    def by_channel(self, scale: float) -> dict[Field, AxisPower]:
        """Power in each field at a scale of the prior."""
        power: dict[Field, AxisPower] = {field: [[np.empty(0), np.empty(0)] for _ in range(3)] for field in FIELDS}
        for odd, (eigenvalues, fields) in enumerate(self._modes):
            std = scale / np.sqrt(scale * eigenvalues + 1.0)
            carried = std * np.linalg.norm(fields["traction"], axis=1)
            for field in FIELDS:
                weighted = fields[field] * (carried if field == "sensor" else std)[:, None, :]
                odds = _odd(field, self._axis, odd)
                ends = np.cumsum([half(self._count, o) for o in odds])[:2]
                for channel, part in enumerate(np.split(weighted, ends, axis=1)):
                    power[field][channel][odds[channel]] = part @ part.swapaxes(1, 2)
        return power


def frequencies(size: int) -> Floats:
    """At the midpoints of `size` equal steps from 0 to half a wave per site, in rad per site."""
    return (np.arange(size) + 0.5) * np.pi / size


def _odd(field: Field, axis: int, odd: int) -> list[int]:
    """Parity of each channel along an axis where p_n and f_z have the parity `odd`."""
    return [parity[axis] for parity in parities(field, (odd, odd))]


def _density(
    prior: StationaryPrior, grid: Grid, depth_m: float, field: Field, omega_x: Floats, omega_y: Floats
) -> Complexes:
    """Spectral density of samples on the grid, those of shorter waves folded back: (y, x, 3, 3)."""
    highest = np.pi / grid.pitch_x_m, np.pi / grid.pitch_y_m
    images = [2.0 * w * np.arange(-k, k + 1) for w in highest for k in [int(_FADED / depth_m / w / 2.0 + 0.5)]]
    density: Complexes = np.zeros((omega_y.size, omega_x.size, 3, 3), np.complex128)
    for x in images[0]:
        for y in images[1]:
            row_depth_m = depth_m if field == "sensor" else 0.0
            density += prior.spectral_density(field, row_depth_m, "sensor", depth_m, omega_x + x, omega_y[:, None] + y)
    return density / (grid.pitch_x_m * grid.pitch_y_m)


def _lags(density: Complexes, field: Field, axis: int, count: int) -> Floats:
    """From densities (y, x, 3, 3) to covariances at lags 1 - count .. count - 1 along an axis: (across, lags, 3, 3)."""
    along = density if axis == 0 else density.swapaxes(0, 1)
    rows, columns = np.ones((2, 3), np.complex128)
    rows[_ACROSS[field][axis]] = columns[_ACROSS["sensor"][axis]] = 1j
    along = along * rows[:, None] * columns.conj()
    lags = np.outer(np.arange(1 - count, count), frequencies(along.shape[1]))
    # Along the axis a wave and its mirror image together are real: even entries by cosines, odd ones by sines.
    size = along.shape[1]
    even, odd = along.real.reshape(len(along), size, 9), along.imag.reshape(len(along), size, 9)
    found = (np.cos(lags) @ even - np.sin(lags) @ odd) / size
    return np.asarray(found.reshape(len(along), -1, 3, 3), np.float64)


def _folded(table: Floats, field: Field, axis: int, odd: int, count: int) -> Floats:
    """Covariance between even and odd vectors of both fields' channels, (across, rows, columns)."""
    rows, columns = _odd(field, axis, odd), _odd("sensor", axis, odd)
    return np.concatenate(
        [
            np.concatenate([fold(table[:, :, r, c], count, row, column) for c, column in enumerate(columns)], axis=2)
            for r, row in enumerate(rows)
        ],
        axis=1,
    )
