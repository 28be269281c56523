"""Eigenmodes of a regular grid of sites in a reduced, separable basis: a few small products in place of one large one.

Parity splits the covariances into four blocks, exactly. Each axis then keeps the even and odd vectors that the estimate
uses: the leading eigenvectors of the marginals of V w V' for the signals and of F w F' for the surface, w weighting the
modes by their part in the estimate. Of the products of both axes' vectors those stay that carry the estimate. Strong
signals need more than faint ones: there is a set for each level.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.decoding.layout import Grid
from resonator_daemon.decoding.open_plane.modes import Floats, Modes, Singles, explained_variance
from resonator_daemon.decoding.open_plane.parity import CLASSES, class_block, half, offset_table, parities, unfold
from resonator_daemon.decoding.open_plane.prior_tables import Field, StationaryPrior


class Level(NamedTuple):
    """Power of signals over noise up to which a set of bases serves, and shares of the estimate's power it may lose.

    The shares are those that raise the error of a contact by less than 1 %. What the signals lose lies close to the
    noise; the surface may lose less the more of it is seen.
    """

    power: float
    signals: float
    surface: float


LEVELS = (
    Level(1.5e2, 0.006, 0.0025),
    Level(1.5e3, 0.009, 0.0035),
    Level(1.5e4, 0.004, 0.0020),
    Level(1.5e6, 0.002, 0.0012),
)
_HEADROOM = 8.0  # of the scale: a contact puts the array's power on a tenth of its area, and its edges are sharp
_FEWEST = 150  # products of a class: fewer save no time
_DISPLACEMENT_PART = 0.2  # of the surface's share: most of the power is in long waves, which take few vectors
# Parts of these shares that each axis' vectors may lose, before the products are chosen.
_AXIS_PART: dict[Field, float] = {"sensor": 0.1, "traction": 0.2, "displacement": 0.2}


class _Bases:
    """Even and odd vectors along both axes, as many of each, and the products of them that each class keeps."""

    def __init__(self, grid: Grid, field: Field, blocks: list[Floats], left_out: float) -> None:
        """From matrices (channels of a class, r), one for each class, whose squares are the power to be kept."""
        self._grid = grid
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
        self._folded = [_leading(power[axis, 0], power[axis, 1], _AXIS_PART[field] * left_out) for axis in (0, 1)]
        self.x, self.y = (  # columns of (count, 2 k), even ones first
            np.hstack([unfold(n, odd) @ self._folded[axis][odd] for odd in (0, 1)]) for axis, n in enumerate((nx, ny))
        )
        ky, kx = self.y.shape[1], self.x.shape[1]
        place = np.arange(3 * ky * kx).reshape(2, kx // 2, 3, 2, ky // 2)
        power_of_class = np.array([np.sum(self._products(block, i) ** 2, axis=1) for i, block in enumerate(blocks)])
        ranks = np.argsort(-power_of_class, axis=1)
        by_rank = np.take_along_axis(power_of_class, ranks, axis=1).sum(axis=0)
        self._kept = ranks[:, : max(_FEWEST, _needed(by_rank, left_out))]
        self.places = np.array(  # of what each class keeps, in (2 kx, 3, 2 ky): two plain products lead there and back
            [
                np.concatenate([place[x, :, c, y].T.ravel() for c, (x, y) in enumerate(parities(field, parity))])[kept]
                for parity, kept in zip(CLASSES, self._kept, strict=True)
            ]
        )

    def reduce(self, block: Floats, index: int) -> Floats:
        """Coefficients in the bases: rows (channels of a class) to rows (products kept)."""
        kept: Floats = self._products(block, index)[self._kept[index]]
        return kept

    def _products(self, block: Floats, index: int) -> Floats:
        parity, count = CLASSES[index], block.shape[1]
        products = []
        for (x, y), part in zip(
            parities(self._field, parity), np.split(block, _bounds(self._grid, self._field, parity)), strict=True
        ):
            along_y, along_x = self._folded[1][y], self._folded[0][x]
            columns = (along_y.T @ part.reshape(len(along_y), -1)).reshape(-1, len(along_x), count)
            products.append((along_x.T @ columns).reshape(-1, count))
        return np.concatenate(products)


class _Synthesis:
    """From modes (4 r,) to a field on the grid, flat (3 ny nx,), or to some of its components."""

    def __init__(self, bases: _Bases, blocks: list[Floats], components: tuple[int, ...] = (0, 1, 2)) -> None:
        x, component, y = np.unravel_index(bases.places, (bases.x.shape[1], 3, bases.y.shape[1]))
        asked = np.isin(component, components)
        # Classes keep unequal numbers of products of a component: the surplus goes to a place of its own.
        most = int(asked.sum(axis=1).max())
        rows = np.argsort(~asked, axis=1, kind="stable")[:, :most]
        shape = bases.x.shape[1], len(components), bases.y.shape[1]
        self._size = int(np.prod(shape))
        inner = np.clip(np.searchsorted(components, component), 0, len(components) - 1)
        places = np.where(asked, np.ravel_multi_index((x, inner, y), shape), self._size)
        self._places = np.take_along_axis(places, rows, axis=1).ravel()
        self._blocks = np.take_along_axis(np.array(blocks, np.float32), rows[..., None], axis=1)
        self._y = np.ascontiguousarray(bases.y.T, np.float32)
        self._x = np.ascontiguousarray(bases.x.T, np.float32)

    def __call__(self, modes: Singles) -> Singles:
        coefficients = np.zeros(self._size + 1, np.float32)
        coefficients[self._places] = (self._blocks @ modes.reshape(4, -1, 1)).ravel()
        columns = coefficients[:-1].reshape(-1, len(self._y)).dot(self._y).reshape(len(self._x), -1)
        field: Singles = columns.T.dot(self._x).ravel()
        return field


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
    """Eigenmodes in bases that serve up to a level."""

    def __init__(self, whole: WholeGrid, level: Level) -> None:
        self._grid = grid = whole.grid
        self.explained_variance = whole.explained_variance
        scale = min(level.power / whole.mean_power, _HEADROOM * whole.largest_scale)
        weighted: dict[Field, list[Floats]] = {"sensor": [], "traction": [], "displacement": []}
        for eigenvalues, vectors, traction, displacement in whole.classes:
            std = scale / np.sqrt(scale * eigenvalues + 1.0)
            weighted["traction"].append(traction * std)
            weighted["displacement"].append(displacement * std)
            weighted["sensor"].append(vectors * (std * np.linalg.norm(traction, axis=0)))

        bases: dict[Field, _Bases] = {
            "sensor": _Bases(grid, "sensor", weighted["sensor"], level.signals),
            "traction": _Bases(grid, "traction", weighted["traction"], level.surface),
            "displacement": _Bases(grid, "displacement", weighted["displacement"], _DISPLACEMENT_PART * level.surface),
        }
        values_of_class: list[Floats] = []
        rotations: list[Floats] = []
        surface: dict[Field, list[Floats]] = {"traction": [], "displacement": []}
        for index, (eigenvalues, vectors, traction, displacement) in enumerate(whole.classes):
            seen = bases["sensor"].reduce(vectors, index)
            values, rotation = np.linalg.eigh((seen * eigenvalues) @ seen.T)
            back = seen.T @ rotation
            values_of_class.append(np.maximum(values, 0.0))
            rotations.append(rotation)
            surface["traction"].append(bases["traction"].reduce(traction @ back, index))
            surface["displacement"].append(bases["displacement"].reduce(displacement @ back, index))
        self.eigenvalues = np.concatenate(values_of_class)
        self._sensor = bases["sensor"]
        self._rotation = np.array(rotations)
        self._to_traction = _Synthesis(bases["traction"], surface["traction"])
        self._to_pressure = _Synthesis(bases["traction"], surface["traction"], (2,))
        self._to_displacement = _Synthesis(bases["displacement"], surface["displacement"])
        self._x = np.ascontiguousarray(self._sensor.x.T, np.float32)
        self._y = np.ascontiguousarray(self._sensor.y, np.float32)
        self._to_modes = np.ascontiguousarray(self._rotation.swapaxes(1, 2), np.float32)

    def project(self, whitened: Singles) -> Singles:
        columns = self._x.dot(whitened.reshape(-1, self._grid.shape[1]).T).reshape(-1, self._grid.shape[0])
        coefficients = columns.dot(self._y).take(self._sensor.places)
        modes: Singles = (self._to_modes @ coefficients[..., None]).ravel()
        return modes

    def traction(self, modes: Singles) -> Singles:
        return self._to_traction(modes)

    def pressure(self, modes: Singles) -> Singles:
        return self._to_pressure(modes)

    def displacement(self, modes: Singles) -> Singles:
        return self._to_displacement(modes)

    def rows(self, signals: NDArray[np.intp]) -> Floats:
        channel, y, x = np.unravel_index(signals, (3, *self._grid.shape))
        coefficients = np.zeros((signals.size, self._sensor.x.shape[1], 3, self._sensor.y.shape[1]))
        coefficients[np.arange(signals.size), :, channel] = (
            self._sensor.x[x][:, :, None] * self._sensor.y[y][:, None, :]
        )
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
    sensor = offset_table(grid, prior, "sensor", depth_m, "sensor", depth_m) / noise_std[:, None, None, None]
    tables: list[tuple[Field, Floats]] = [
        (field, offset_table(grid, prior, field, 0.0, "sensor", depth_m)) for field in ("traction", "displacement")
    ]
    for parity in CLASSES:
        eigenvalues, vectors = np.linalg.eigh(
            class_block(grid, sensor / noise_std[:, None, None], "sensor", "sensor", parity)
        )
        traction, displacement = (
            class_block(grid, table / noise_std[:, None, None], field, "sensor", parity) @ vectors
            for field, table in tables
        )
        yield np.maximum(eigenvalues, 0.0), vectors, traction, displacement


def _bounds(grid: Grid, field: Field, parity: tuple[int, int]) -> NDArray[np.intp]:
    """Where the second and the third channel of a class begin."""
    ny, nx = grid.shape
    return np.cumsum([half(ny, y) * half(nx, x) for x, y in parities(field, parity)])[:2]


def _leading(even: Floats, odd: Floats, left_out: float) -> list[Floats]:
    """Leading eigenvectors of both matrices, as many of each as the one in need of more needs."""
    values, vectors = zip(*(np.linalg.eigh(matrix) for matrix in (even, odd)), strict=True)
    needed = max(_needed(value[::-1], left_out) for value in values)
    count = min(needed, *(value.size for value in values))
    return [vector[:, ::-1][:, :count] for vector in vectors]


def _needed(power: Floats, left_out: float) -> int:
    """Count the leading entries after which no more than a share of the sum is left."""
    rest = power.sum() - np.cumsum(power)
    return int(np.argmax(rest <= left_out * power.sum())) + 1
