"""Square pixels that may carry load, with the prior of that load; they cover the sites and a margin around them.

Fields on pixels are shown at places. Few pixels carry load: their displacements are convolved on the smallest transform
that holds their bounding box and the places, by small matrices; spectra are kept for each box.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.spatial import Delaunay, QhullError

from resonator_daemon.base.arrays import Bools, ComplexSingles, Floats, Indices, Singles
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance
from resonator_daemon.estimate.surface.layout import as_grid

_PITCH_DEPTHS = 0.4  # finer pixels than this cannot be distinguished at depth
_GRID_DEPTHS = (0.25, 0.5)  # pitches of a site grid that serve as they are
_MARGIN_DEPTHS = 3.2
_NEGLIGIBLE = 1e-6  # weight of an interpolation
_PERIOD_LENGTHS = 30.0  # correlation lengths of a period: the correlation has faded to exp(-15) halfway


class Interpolation(NamedTuple):
    """Interpolation of fields: each target is a weighted sum of at most k sources."""

    sources: Indices  # (targets, k), in rows that are filled up with any source
    weights: Singles  # (targets, k), 0 where filled up

    @classmethod
    def of_entries(cls, targets: Indices, sources: Indices, weights: Floats, count: int) -> "Interpolation":
        """Collect single entries (e,) for `count` targets."""
        order = np.argsort(targets, kind="stable")
        targets, sources, weights = targets[order], sources[order], weights[order]
        entries = np.bincount(targets, minlength=count)
        column = np.arange(targets.size) - np.repeat(np.cumsum(entries) - entries, entries)
        shape = count, max(int(entries.max(initial=1)), 1)
        found = cls(np.zeros(shape, np.intp), np.zeros(shape, np.float32))
        found.sources[targets, column], found.weights[targets, column] = sources, weights
        return found

    @property
    def reached(self) -> Bools:
        """Targets that have a source, (targets,)."""
        return np.asarray((self.weights > 0.0).any(axis=1), np.bool_)

    def __call__(self, fields: Singles) -> Singles:
        """Return fields (..., sources) at the targets, (..., targets)."""
        if self.sources.shape[1] == 1:
            return np.asarray(fields.take(self.sources[:, 0], axis=-1) * self.weights[:, 0], np.float32)
        return np.asarray(np.vecdot(fields.take(self.sources, axis=-1), self.weights), np.float32)

    def of(self, chosen: Indices, count: int) -> "Interpolation":
        """Restrict the `count` sources to some of them (c,), which are numbered as they come; others count as 0."""
        number = np.full(count, -1)
        number[chosen] = np.arange(chosen.size)
        sources = number[self.sources]
        return Interpolation(np.maximum(sources, 0), np.where(sources >= 0, self.weights, np.float32(0.0)))


@dataclass(frozen=True)
class PixelLattice:
    """Square pixels in rows along y; centres lie at origin_m + pitch_m (column, row)."""

    origin_m: tuple[float, float]
    pitch_m: float
    shape: tuple[int, int]

    @classmethod
    def over(cls, positions_m: Floats, depth_m: float) -> "PixelLattice":
        """Return the pixels over sites (n, 2) and 3.2 depths beyond; centred on those of a grid that is fine enough."""
        pitch_m = _PITCH_DEPTHS * depth_m
        grid = as_grid(positions_m)
        if (
            grid
            and np.isclose(grid.pitch_x_m, grid.pitch_y_m)
            and _GRID_DEPTHS[0] * depth_m <= grid.pitch_x_m <= _GRID_DEPTHS[1] * depth_m
        ):
            pitch_m = grid.pitch_x_m
        low_m, high_m = positions_m.min(axis=0), positions_m.max(axis=0)
        margin = int(np.ceil(_MARGIN_DEPTHS * depth_m / pitch_m - _NEGLIGIBLE))
        counts = np.ceil((high_m - low_m) / pitch_m - _NEGLIGIBLE).astype(int)
        origin_m = (low_m + high_m - counts * pitch_m) / 2.0 - margin * pitch_m
        nx, ny = (int(count) + 1 + 2 * margin for count in counts)
        return cls((float(origin_m[0]), float(origin_m[1])), float(pitch_m), (ny, nx))

    @property
    def centres_m(self) -> Floats:
        """Row by row, (ny nx, 2)."""
        ny, nx = self.shape
        y, x = np.divmod(np.arange(ny * nx), nx)
        return np.asarray(self.origin_m + self.pitch_m * np.column_stack([x, y]), np.float64)

    def nearest(self, positions_m: Floats) -> Indices:
        """Flat index of the pixel nearest to each place, (m,)."""
        ny, nx = self.shape
        x, y = np.rint((positions_m - self.origin_m) / self.pitch_m).astype(np.intp).T
        return np.asarray(np.clip(y, 0, ny - 1) * nx + np.clip(x, 0, nx - 1), np.intp)

    def to_places(self, positions_m: Floats) -> Interpolation:
        """Bilinear interpolation from ny nx pixels to m places; 0 beyond the outermost centres."""
        ny, nx = self.shape
        place = (positions_m - self.origin_m) / self.pitch_m
        corner = np.floor(place + _NEGLIGIBLE).astype(int)
        share = np.clip(place - corner, 0.0, 1.0)
        rows, columns, weights = [], [], []
        for dx in (0, 1):
            for dy in (0, 1):
                x, y = corner[:, 0] + dx, corner[:, 1] + dy
                weight = np.abs(1 - dx - share[:, 0]) * np.abs(1 - dy - share[:, 1])
                kept = np.flatnonzero((weight > _NEGLIGIBLE) & (x >= 0) & (x < nx) & (y >= 0) & (y < ny))
                rows.append(kept)
                columns.append(y[kept] * nx + x[kept])
                weights.append(weight[kept])
        entries = np.concatenate(rows), np.concatenate(columns), np.concatenate(weights)
        return Interpolation.of_entries(*entries, len(positions_m))

    def from_places(self, positions_m: Floats) -> Interpolation:
        """Linear interpolation from m places to ny nx pixels, of which those outside the hull get 0."""
        scaled = positions_m / self.pitch_m
        try:
            triangles = Delaunay(scaled)
        except QhullError:
            raise ValueError("all places lie on a line, must span an area for a map of pressure") from None
        centres = self.centres_m / self.pitch_m
        inside = triangles.find_simplex(centres, tol=_NEGLIGIBLE)
        pixels = np.flatnonzero(inside >= 0)
        transform = triangles.transform[inside[pixels]]
        two = np.einsum("nij,nj->ni", transform[:, :2], centres[pixels] - transform[:, 2])
        weights = np.column_stack([two, 1.0 - two.sum(axis=1)])
        kept = weights > _NEGLIGIBLE
        rows = np.repeat(pixels, 3).reshape(-1, 3)[kept]
        columns = triangles.simplices[inside[pixels]][kept].astype(np.intp)
        return Interpolation.of_entries(rows, columns, weights[kept], len(centres))


class PixelPrior:
    """Load of unit variance with the correlation exp(-d / l) between pixels.

    On a plane of pixels the precision depends on the offset alone: it is the inverse transform of the reciprocal of the
    correlation's transform. Its part that belongs to some pixels is their precision given 0 on all the others.

    Parameters
    ----------
    lattice
    correlation_length_m
        l.
    """

    def __init__(self, lattice: PixelLattice, correlation_length_m: float) -> None:
        length = correlation_length_m / lattice.pitch_m
        period = fft.next_fast_len(max(2 * max(lattice.shape), int(np.ceil(_PERIOD_LENGTHS * length))), real=True)
        lags = np.minimum(np.arange(period), period - np.arange(period))
        spectrum = fft.rfft2(np.exp(-np.hypot(lags[:, None], lags) / length)).real
        self._table = fft.irfft2(1.0 / spectrum, (period, period))[: lattice.shape[0], : lattice.shape[1]].astype(
            np.float32
        )
        self._width = lattice.shape[1]

    def precision(self, rows: Indices, columns: Indices) -> Singles:
        """Precision between pixels of flat indices (r,) and (c,), of shape (r, c)."""
        (y, x), (other_y, other_x) = np.divmod(rows, self._width), np.divmod(columns, self._width)
        offsets = np.abs(y[:, None] - other_y) * self._width + np.abs(x[:, None] - other_x)
        return np.asarray(self._table.take(offsets), np.float32)


class SurfacePlaces:
    """Places that are shown (m, 2), over a lattice of pixels."""

    def __init__(self, half_space: HalfSpace, lattice: PixelLattice, positions_m: Floats) -> None:
        self.count = len(positions_m)
        self.to_places = lattice.to_places(positions_m)
        self.nearest = lattice.nearest(positions_m)
        self.width = lattice.shape[1]
        compliance = SurfaceCompliance(half_space, lattice.shape, lattice.pitch_m)
        coefficients = compliance.coefficients(lattice.shape).astype(np.float32)
        pairs = [pair for pair in np.ndindex(3, 3) if coefficients[pair].any()]
        self.coefficients = np.array([coefficients[pair] for pair in pairs])  # of output and input component
        self.inputs = np.array([column for _, column in pairs])
        self.first_inputs = np.array([[row for row, _ in pairs].index(component) for component in range(3)])
        self.reach = lattice.shape[0] - 1, lattice.shape[1] - 1  # lags of the coefficients
        rows, columns = np.divmod(np.unique(self.to_places.sources[self.to_places.weights > 0.0]), self.width)
        self.corner = int(rows.min()), int(columns.min())
        self.window = int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1
        y, x = (begin + np.arange(count) for begin, count in zip(self.corner, self.window, strict=True))
        self.pixel_count = lattice.shape[0] * lattice.shape[1]
        self.from_window = self.to_places.of((y[:, None] * self.width + x).ravel(), self.pixel_count)


class SurfaceView:
    """Fields on n pixels, flat indices into the lattice, shown at the places."""

    def __init__(self, places: SurfacePlaces, pixels: Indices) -> None:
        self._places = places
        to_places = places.to_places.of(pixels, places.pixel_count)
        self._touched = np.flatnonzero(to_places.reached)
        self._to_touched = Interpolation(to_places.sources[self._touched], to_places.weights[self._touched])
        number = np.full(places.pixel_count, -1)
        number[pixels] = np.arange(pixels.size)
        nearest = number[places.nearest]
        self.covered = np.flatnonzero(nearest >= 0)  # places of which the nearest pixel is one of these
        self.nearest = nearest[self.covered]  # that pixel, as one of the n
        self._prepare_displacement(pixels)

    def traction(self, traction: Singles) -> Floats:
        """Return the traction of the places (3, m) from that of the pixels (3, n), interpolated."""
        shown = np.zeros((3, self._places.count))
        shown[:, self._touched] = self._to_touched(traction)
        return shown

    def displacement(self, traction: Singles) -> Floats:
        """Displacement of the places (3, m) by tractions of the pixels (3, n)."""
        places = self._places
        box = np.zeros((3, *self._box), np.float32)
        box[:, self._y, self._x] = traction
        along_x = (box.reshape(-1, box.shape[2]) @ self._to_x).view(np.complex64).reshape(3, self._box[0], -1)
        inputs = self._to_y @ along_x
        outputs = np.add.reduceat(self._spectra * inputs.take(places.inputs, axis=0), places.first_inputs, axis=0)
        columns = np.ascontiguousarray(self._from_y @ outputs)
        window = columns.reshape(3 * places.window[0], -1).view(np.float32) @ self._from_x
        return places.from_window(window.reshape(3, -1)).astype(np.float64)

    def _prepare_displacement(self, pixels: Indices) -> None:
        places = self._places
        y, x = np.divmod(pixels, places.width)
        top, left = int(y.min()), int(x.min())
        self._y, self._x = y - top, x - left
        self._box = h, w = int(self._y.max()) + 1, int(self._x.max()) + 1
        # Lags from the last pixel of the box to the first of the window, and so on to the opposite.
        ny, nx = (count + side - 1 for count, side in zip(places.window, self._box, strict=True))
        first_y = places.reach[0] + places.corner[0] - top - (h - 1)
        first_x = places.reach[1] + places.corner[1] - left - (w - 1)
        lags = places.coefficients[:, first_y : first_y + ny, first_x : first_x + nx]
        self._spectra: ComplexSingles = fft.rfft2(lags)
        half = nx // 2 + 1
        self._to_x = _waves(np.arange(w), half, nx, -1).view(np.float32)
        self._to_y = _waves(np.arange(ny), h, ny, -1)
        self._from_y = _waves(np.arange(h - 1, ny), ny, ny, 1) / np.float32(ny)
        weight = np.full((half, 1), 2.0 / nx, np.float32)  # of frequencies that stand for their negatives, too
        weight[0] = 1.0 / nx
        if nx % 2 == 0:
            weight[-1] = 1.0 / nx
        back = _waves(np.arange(half), nx, nx, 1)[:, w - 1 :] * weight
        self._from_x = np.stack([back.real, -back.imag], axis=1).reshape(2 * half, -1)


def _waves(rows: Indices, columns: int, period: int, sign: int) -> ComplexSingles:
    """exp(sign 2 pi i r c / period) for rows r and columns c from 0."""
    return np.exp(sign * 2j * np.pi / period * (np.multiply.outer(rows, np.arange(columns)) % period)).astype(
        np.complex64
    )
