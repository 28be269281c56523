"""Eigenmodes of a regular grid of sites in a reduced, separable basis: a few small products in place of one large one.

Parity splits the covariances into four blocks, exactly. Each axis then keeps the even and odd vectors that the estimate
uses: the leading eigenvectors of the marginals of V w V' for the signals and of F w F' for the surface, w weighting the
modes by their part in the estimate. Strong signals need more vectors than faint ones: there is a set for each level.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.decoding.modes import Floats, Modes, Singles, explained_variance
from resonator_daemon.decoding.parity import CLASSES, Grid, half, parities, unfold
from resonator_daemon.decoding.prior_tables import Field, StationaryPrior

LEVELS = (1.5e2, 1.5e3, 1.5e4, 1.5e6)  # power of signals over noise, up to which each set of bases serves
_HEADROOM = 8.0  # of the scale: a contact puts the array's power on a tenth of its area, and its edges are sharp
# Shares of the estimate's power that may be lost; those of the signals and of the modes lie close to the noise.
_LEFT_OUT: dict[Field, float] = {"sensor": 4e-3, "traction": 1.2e-3, "displacement": 1.2e-3}
_LEFT_OUT_MODES = 8e-3
_FEWEST = 10  # vectors of each parity, and root of the modes of each class: fewer save no time


class _AxisBases:
    """Even and odd vectors along both axes, as many of each: columns of (count, 2 k), even ones first."""

    def __init__(self, grid: Grid, field: Field, blocks: list[Floats]) -> None:
        """From matrices (channels of a class, r), one for each class, whose squares are the power to be kept."""
        self._field: Field = field
        ny, nx = grid.shape
        power = {(axis, odd): np.zeros((half(n, odd),) * 2) for axis, n in enumerate((nx, ny)) for odd in (0, 1)}
        for parity, block in zip(CLASSES, blocks, strict=True):
            for (x, y), channel in zip(
                parities(field, parity), np.split(block, _bounds(grid, field, parity)), strict=True
            ):
                cube = channel.reshape(half(ny, y), half(nx, x), -1)
                along_x, along_y = cube.swapaxes(0, 1).reshape(half(nx, x), -1), cube.reshape(half(ny, y), -1)
                power[0, x] += along_x @ along_x.T
                power[1, y] += along_y @ along_y.T
        self._folded = [_leading(power[axis, 0], power[axis, 1], _LEFT_OUT[field]) for axis in (0, 1)]
        self.x, self.y = (
            np.hstack([unfold(n, odd) @ self._folded[axis][odd] for odd in (0, 1)]) for axis, n in enumerate((nx, ny))
        )
        ky, kx = self.y.shape[1], self.x.shape[1]
        place = np.arange(3 * ky * kx).reshape(3, 2, ky // 2, 2, kx // 2)
        self.places = np.array(  # of what belongs to each class, in (3, 2 ky, 2 kx)
            [
                np.concatenate([place[c, y, :, x].ravel() for c, (x, y) in enumerate(parities(field, parity))])
                for parity in CLASSES
            ]
        )

    def reduce(self, block: Floats, grid: Grid, index: int) -> Floats:
        """Coefficients in the bases: rows (channels of a class) to rows (channels, reduced)."""
        parity = CLASSES[index]
        parts = np.split(block, _bounds(grid, self._field, parity))
        return np.concatenate(
            [
                np.kron(self._folded[1][y], self._folded[0][x]).T @ part
                for (x, y), part in zip(parities(self._field, parity), parts, strict=True)
            ]
        )


class _Synthesis:
    """From modes (4, r) to a field on the grid, flat (3 ny nx,)."""

    def __init__(self, bases: _AxisBases, blocks: list[Floats]) -> None:
        self._shape = (3, bases.y.shape[1], bases.x.shape[1])
        self._places = np.argsort(bases.places.ravel())
        self._blocks = np.array(blocks, np.float32)
        self._y = np.ascontiguousarray(bases.y, np.float32)
        self._x = np.ascontiguousarray(bases.x.T, np.float32)

    def __call__(self, modes: Singles) -> Singles:
        coefficients = (self._blocks @ modes.reshape(4, -1, 1)).ravel().take(self._places).reshape(self._shape)
        rows = (self._y @ coefficients).reshape(-1, self._shape[2])
        return (rows @ self._x).ravel()


class WholeGrid:
    """L, V, F and F of the displacement of each class, nothing left out.

    Of a regular grid of sites at one depth with equal noise in each channel; the surface is asked for at the sites.

    Parameters
    ----------
    prior
        At scale 1.
    grid
    depth_m
    noise_std
        Of each channel, (3,).
    scales
        Bank of scales, (k,).
    """

    def __init__(self, prior: StationaryPrior, grid: Grid, depth_m: float, noise_std: Floats, scales: Floats) -> None:
        self.grid = grid
        self.largest_scale = float(scales.max())
        self.classes = list(_whole_modes(prior, grid, depth_m, noise_std))
        self.mean_power = sum(float(values.sum()) for values, *_ in self.classes) / (3 * grid.shape[0] * grid.shape[1])
        explained = np.zeros((scales.size, 3, *grid.shape))
        for parity, (eigenvalues, _, traction, _) in zip(CLASSES, self.classes, strict=True):
            _spread(grid, parity, explained_variance(traction, eigenvalues, scales), explained)
        self.explained_variance = explained.reshape(scales.size, -1)


class GridModes(Modes):
    """Eigenmodes in bases that serve up to a power `level` of signals over noise."""

    def __init__(self, whole: WholeGrid, level: float) -> None:
        self._grid = grid = whole.grid
        self.explained_variance = whole.explained_variance
        scale = min(level / whole.mean_power, _HEADROOM * whole.largest_scale)
        weighted: dict[Field, list[Floats]] = {"sensor": [], "traction": [], "displacement": []}
        for eigenvalues, vectors, traction, displacement in whole.classes:
            std = scale / np.sqrt(scale * eigenvalues + 1.0)
            weighted["traction"].append(traction * std)
            weighted["displacement"].append(displacement * std)
            weighted["sensor"].append(vectors * (std * np.linalg.norm(traction, axis=0)))

        bases = {field: _AxisBases(grid, field, blocks) for field, blocks in weighted.items()}
        reduced = []
        for index, (eigenvalues, vectors, traction, displacement) in enumerate(whole.classes):
            seen = bases["sensor"].reduce(vectors, grid, index)
            values, rotation = np.linalg.eigh((seen * np.maximum(eigenvalues, 0.0)) @ seen.T)
            values, rotation = np.maximum(values[::-1], 0.0), rotation[:, ::-1]
            back = seen.T @ rotation
            reduced.append(
                (
                    values,
                    rotation,
                    bases["traction"].reduce(traction @ back, grid, index),
                    bases["displacement"].reduce(displacement @ back, grid, index),
                )
            )
        kept = max(
            _FEWEST**2,
            *(
                _needed(scale**2 / (scale * values + 1.0) * np.sum(traction**2, axis=0), _LEFT_OUT_MODES)
                for values, _, traction, _ in reduced
            ),
        )
        self.eigenvalues = np.concatenate([values[:kept] for values, *_ in reduced])
        self._sensor = bases["sensor"]
        self._rotation = np.array([rotation[:, :kept] for _, rotation, *_ in reduced])
        self._to_traction = _Synthesis(bases["traction"], [block[:, :kept] for *_, block, _ in reduced])
        self._to_displacement = _Synthesis(bases["displacement"], [block[:, :kept] for *_, block in reduced])
        self._x = np.ascontiguousarray(self._sensor.x, np.float32)
        self._y = np.ascontiguousarray(self._sensor.y.T, np.float32)
        self._to_modes = np.ascontiguousarray(self._rotation.swapaxes(1, 2), np.float32)

    def project(self, whitened: Singles) -> Singles:
        rows = (whitened.reshape(-1, self._grid.shape[1]) @ self._x).reshape(3, self._grid.shape[0], -1)
        coefficients = (self._y @ rows).ravel().take(self._sensor.places)
        return (self._to_modes @ coefficients[..., None]).ravel()

    def traction(self, modes: Singles) -> Singles:
        return self._to_traction(modes)

    def displacement(self, modes: Singles) -> Singles:
        return self._to_displacement(modes)

    def rows(self, signals: NDArray[np.intp]) -> Floats:
        channel, y, x = np.unravel_index(signals, (3, *self._grid.shape))
        coefficients = np.zeros((signals.size, 3, self._sensor.y.shape[1], self._sensor.x.shape[1]))
        coefficients[np.arange(signals.size), channel] = self._sensor.y[y][:, :, None] * self._sensor.x[x][:, None, :]
        of_class = coefficients.reshape(signals.size, -1)[:, self._sensor.places].swapaxes(0, 1)
        rows: Floats = (of_class @ self._rotation).swapaxes(0, 1).reshape(signals.size, -1)
        return rows


def _spread(grid: Grid, parity: tuple[int, int], variance: Floats, total: Floats) -> None:
    """Add a class's variances (k, channels of the class) of the traction to those on the grid (k, 3, ny, nx)."""
    ny, nx = grid.shape
    parts = np.split(variance, _bounds(grid, "traction", parity), axis=1)
    for channel, ((x, y), part) in enumerate(zip(parities("traction", parity), parts, strict=True)):
        power_x, power_y = unfold(nx, x) ** 2, unfold(ny, y) ** 2
        total[:, channel] += power_y @ part.reshape(-1, half(ny, y), half(nx, x)) @ power_x.T


def _whole_modes(
    prior: StationaryPrior, grid: Grid, depth_m: float, noise_std: Floats
) -> Iterator[tuple[Floats, Floats, Floats, Floats]]:
    """L, V, F and F of the displacement of each class."""
    sensor = grid.table(prior, "sensor", depth_m, "sensor", depth_m) / noise_std[:, None, None, None]
    tables: list[tuple[Field, Floats]] = [
        (field, grid.table(prior, field, 0.0, "sensor", depth_m)) for field in ("traction", "displacement")
    ]
    for parity in CLASSES:
        eigenvalues, vectors = np.linalg.eigh(grid.block(sensor / noise_std[:, None, None], "sensor", "sensor", parity))
        traction, displacement = (
            grid.block(table / noise_std[:, None, None], field, "sensor", parity) @ vectors for field, table in tables
        )
        yield np.maximum(eigenvalues, 0.0), vectors, traction, displacement


def _bounds(grid: Grid, field: Field, parity: tuple[int, int]) -> NDArray[np.intp]:
    """Where the second and the third channel of a class begin."""
    ny, nx = grid.shape
    return np.cumsum([half(ny, y) * half(nx, x) for x, y in parities(field, parity)])[:2]


def _leading(even: Floats, odd: Floats, left_out: float) -> list[Floats]:
    """Leading eigenvectors of both matrices, as many of each as the one in need of more needs."""
    values, vectors = zip(*(np.linalg.eigh(matrix) for matrix in (even, odd)), strict=True)
    needed = max(_FEWEST, *(_needed(value[::-1], left_out) for value in values))
    count = min(needed, *(value.size for value in values))
    return [vector[:, ::-1][:, :count] for vector in vectors]


def _needed(power: Floats, left_out: float) -> int:
    """Count the leading entries after which no more than a share of the sum is left."""
    rest = power.sum() - np.cumsum(power)
    return int(np.argmax(rest <= left_out * power.sum())) + 1
