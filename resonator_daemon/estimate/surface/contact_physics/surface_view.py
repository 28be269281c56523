"""From the pixels that carry load to the places that are shown: tractions, displacements.

Few pixels carry load. Their displacements are convolved on the smallest transform that holds their bounding box and
the places, by small matrices; spectra are kept for each box.
"""

import numpy as np
from scipy import fft

from resonator_daemon.base.arrays import ComplexSingles, Floats, Indices, Singles
from resonator_daemon.estimate.elastic import HalfSpace, SurfaceCompliance
from resonator_daemon.estimate.surface.contact_physics.pixels import Interpolation, PixelLattice


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
