"""Eigenmodes of a regular grid of sites in a reduced, separable basis: a few small products in place of one large one.

Parity splits the covariances into four blocks, exactly. Each block is reduced to bases that carry the estimate.
Strong signals need more of them than faint ones: there is a set for each level.
"""

from typing import NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats, Indices, Singles
from resonator_daemon.estimate.surface.layout import Grid
from resonator_daemon.estimate.surface.open_plane.estimate_power import CLASSES, EstimatePower, offset_table
from resonator_daemon.estimate.surface.open_plane.grid_bases import Bases, Reduction
from resonator_daemon.estimate.surface.open_plane.modes import Modes
from resonator_daemon.estimate.surface.open_plane.prior_tables import Field, StationaryPrior


class Level(NamedTuple):
    """Power of signals over noise up to which a set of bases serves, and shares of the estimate's power it may lose.

    The shares are those that raise the error of a contact by less than 1 %. What the signals lose lies close to the
    noise; the surface may lose less the more of it is seen.
    """

    power: float
    signals: float
    surface: float


LEVELS = (
    Level(1.5e2, 0.0055, 0.0025),
    Level(1.5e3, 0.008, 0.0035),
    Level(1.5e4, 0.0036, 0.0020),
    Level(1.5e6, 0.0016, 0.0012),
)
_HEADROOM = 8.0  # of the scale: a contact puts the array's power on a tenth of its area, and its edges are sharp
_DISPLACEMENT_PART = 0.2  # of the surface's share: most of the power is in long waves, which take few vectors


class _Synthesis:
    """From modes (4 r,) to a field on the grid, flat (3 ny nx,), or to some of its components."""

    def __init__(self, bases: Bases, blocks: Floats, components: tuple[int, ...] = (0, 1, 2)) -> None:
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
        self._blocks = np.take_along_axis(blocks.astype(np.float32), rows[..., None], axis=1)
        self._y = np.ascontiguousarray(bases.y.T, np.float32)
        self._x = np.ascontiguousarray(bases.x.T, np.float32)

    def __call__(self, modes: Singles) -> Singles:
        coefficients = np.zeros(self._size + 1, np.float32)
        coefficients[self._places] = (self._blocks @ modes.reshape(4, -1, 1)).ravel()
        columns = coefficients[:-1].reshape(-1, len(self._y)).dot(self._y).reshape(len(self._x), -1)
        field: Singles = columns.T.dot(self._x).ravel()
        return field

    def quarter(self, index: int) -> Singles:
        """Return the modes of a class on a quarter of the grid, (r, 3, ny / 2, nx / 2) rounded up."""
        y, x = (vectors[:, : -(-vectors.shape[1] // 2)] for vectors in (self._y, self._x))
        block = self._blocks[index]
        coefficients = np.zeros((block.shape[1], len(x) * 3 * len(y)), np.float32)
        coefficients[:, self._places.reshape(4, -1)[index]] = block.T
        along_y = coefficients.reshape(-1, len(x), 3, len(y)) @ y
        return np.asarray(np.einsum("rxcy,xn->rcyn", along_y, x, optimize=True), np.float32)


class GridCovariance:
    """Covariances of a regular grid of sites at one depth with equal noise in each channel, and of the surface at them.

    Parameters
    ----------
    prior
        At scale 1.
    grid
    depth_m
    noise_std
        Of each channel, (3,).
    largest_scale
        Of the prior.
    """

    def __init__(
        self, prior: StationaryPrior, grid: Grid, depth_m: float, noise_std: Floats, largest_scale: float
    ) -> None:
        self.grid = grid
        self.largest_scale = largest_scale
        row_depths_m: dict[Field, float] = {"sensor": depth_m, "traction": 0.0, "displacement": 0.0}
        self.tables = {
            field: offset_table(grid, prior, field, row_depth_m, "sensor", depth_m) / noise_std[:, None, None]
            for field, row_depth_m in row_depths_m.items()
        }
        self.tables["sensor"] /= noise_std[:, None, None, None]
        ny, nx = grid.shape
        self.mean_power = float(np.einsum("cc->", self.tables["sensor"][..., ny - 1, nx - 1])) / 3.0
        self._along_x = EstimatePower(prior, grid, depth_m, noise_std, 0)
        self._along_y = EstimatePower(prior, grid, depth_m, noise_std, 1)

    def bases(self, scale: float, loss: dict[Field, float]) -> dict[Field, Bases]:
        """Return the bases that lose no more than a share of each field's estimate at a scale of the prior."""
        along_x, along_y = self._along_x.by_channel(scale), self._along_y.by_channel(scale)
        return {field: Bases(self.grid, field, along_x[field], along_y[field], share) for field, share in loss.items()}


class GridModes(Modes):
    """Eigenmodes in bases that serve up to a level."""

    traction: _Synthesis
    signals: _Synthesis
    _rotation: Floats  # by class, columns are modes

    def __init__(self, covariance: GridCovariance, level: Level) -> None:
        self._grid = covariance.grid
        scale = min(level.power / covariance.mean_power, _HEADROOM * covariance.largest_scale)
        loss: dict[Field, float] = {
            "sensor": level.signals,
            "traction": level.surface,
            "displacement": _DISPLACEMENT_PART * level.surface,
        }
        bases = covariance.bases(scale, loss)
        blocks: dict[Field, list[Floats]] = {}  # by class
        for field, table in covariance.tables.items():
            reduction = Reduction(table, bases[field], bases["sensor"])
            blocks[field] = [reduction.block(index) for index in range(len(CLASSES))]
        values, self._rotation = np.linalg.eigh(np.array(blocks["sensor"]))
        self.eigenvalues = np.maximum(values, 0.0).ravel()
        self._sensor = bases["sensor"]
        traction = np.array(blocks["traction"]) @ self._rotation
        self.traction = _Synthesis(bases["traction"], traction)
        self.pressure = _Synthesis(bases["traction"], traction, (2,))
        self.displacement = _Synthesis(bases["displacement"], np.array(blocks["displacement"]) @ self._rotation)
        self.signals = _Synthesis(bases["sensor"], self._rotation)
        self._x = np.ascontiguousarray(self._sensor.x.T, np.float32)
        self._y = np.ascontiguousarray(self._sensor.y, np.float32)
        self._to_modes = np.ascontiguousarray(self._rotation.swapaxes(1, 2), np.float32)

    def project(self, whitened: Singles) -> Singles:
        columns = self._x.dot(whitened.reshape(-1, self._grid.shape[1]).T).reshape(-1, self._grid.shape[0])
        coefficients = columns.dot(self._y).take(self._sensor.places)
        modes: Singles = (self._to_modes @ coefficients[..., None]).ravel()
        return modes

    def explained_variance(self, scales: Floats) -> Floats:
        return self._squares(self.traction, scales[:, None] ** 2 / (scales[:, None] * self.eigenvalues + 1.0))

    def explained_signals(self, weights: Floats) -> Floats:
        return self._squares(self.signals, weights[None]).ravel()

    def _squares(self, synthesis: _Synthesis, weights: Floats) -> Floats:
        """Return the sums of the squares of a field's modes with weights (k, r), (k, 3 ny nx)."""
        ny, nx = self._grid.shape
        of_class = [
            np.tensordot(some, synthesis.quarter(index) ** 2, (1, 0))
            for index, some in enumerate(np.split(weights, len(CLASSES), axis=1))
        ]
        quarter = np.sum(of_class, axis=0)  # parity gives the rest
        y, x = (np.minimum(np.arange(count), np.arange(count)[::-1]) for count in (ny, nx))
        return np.asarray(quarter[..., y[:, None], x], np.float64).reshape(len(weights), -1)

    def rows(self, signals: Indices) -> Floats:
        channel, y, x = np.unravel_index(signals, (3, *self._grid.shape))
        coefficients = np.zeros((signals.size, self._sensor.x.shape[1], 3, self._sensor.y.shape[1]))
        coefficients[np.arange(signals.size), :, channel] = (
            self._sensor.x[x][:, :, None] * self._sensor.y[y][:, None, :]
        )
        of_class = coefficients.reshape(signals.size, -1)[:, self._sensor.places].swapaxes(0, 1)
        return (of_class @ self._rotation).swapaxes(0, 1).reshape(signals.size, -1)
