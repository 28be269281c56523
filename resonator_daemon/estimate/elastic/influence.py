"""Displacement of a surface by uniformly loaded pixels: exact coefficients, summed by convolution."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from resonator_daemon.base.arrays import Floats, Indices
from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.elastic.half_space import HalfSpace, finite_array

X, Y, Z = 0, 1, 2


@dataclass(frozen=True)
class SurfaceCompliance:
    """Linear map from the tractions of square pixels to the displacements of their centres, all on the surface.

    Parameters
    ----------
    half_space
        The body.
    shape
        Pixels (ny, nx).
    pitch_m
        Side of a pixel.

    The pixels lie on an infinite plane, free of traction elsewhere. Coefficients are those of the uniformly loaded
    square (Love 1929; Johnson, Contact Mechanics, eqs 3.19 and 3.75 integrated), exact to rounding.

    Raises ValueError for a shape or pitch that `SpectralGrid` refuses.
    """

    half_space: HalfSpace
    shape: tuple[int, int]
    pitch_m: float

    def __post_init__(self) -> None:
        SpectralGrid(self.shape, self.pitch_m)

    def displacement_m(self, traction_pascal: ArrayLike) -> Floats:
        """Displacement of the centres, shape (3, ny, nx), under tractions of that shape, x, y, z.

        ValueError for another shape or a value that is not finite.
        """
        traction = finite_array("traction_pascal", traction_pascal, (3, *self.shape))
        return self.convolution((X, Y, Z), (X, Y, Z), self.shape)(traction)

    def convolution(self, rows: tuple[int, ...], columns: tuple[int, ...], shape: tuple[int, int]) -> "Convolution":
        """Return displacements `rows` by tractions `columns` (0, 1, 2 for x, y, z) in a window of `shape`."""
        ny, nx = shape
        lags_y, lags_x = _lags(ny), _lags(nx)
        squares = _Squares(shape, self.pitch_m)
        kernel = [[self._coefficients(row, column, squares, lags_y, lags_x) for column in columns] for row in rows]
        return Convolution(np.array(kernel), shape)

    def coefficients(self, shape: tuple[int, int]) -> Floats:
        """Return the displacements by unit tractions at each lag among the pixels of a window, in metres per pascal.

        Shape (3, 3, 2 ny - 1, 2 nx - 1): components of the displacement, of the traction, lags 1 - n .. n - 1.
        """
        squares = _Squares(shape, self.pitch_m)
        lags_y, lags_x = (np.arange(1 - count, count) for count in shape)
        axes = (X, Y, Z)
        return np.array([[self._coefficients(row, column, squares, lags_y, lags_x) for column in axes] for row in axes])

    @property
    def of_own_load(self) -> float:
        """Normal displacement of a pixel's centre by its own normal traction, in metres per pascal."""
        at_zero = np.zeros(1, np.intp)
        return float(self._coefficients(Z, Z, _Squares((1, 1), self.pitch_m), at_zero, at_zero)[0, 0])

    def _coefficients(self, row: int, column: int, squares: "_Squares", lags_y: Indices, lags_x: Indices) -> Floats:
        """Displacement in metres per pascal at each lag (y, x) from the loaded pixel."""
        values: Floats = self._quadrant(row, column, squares)[np.ix_(np.abs(lags_y), np.abs(lags_x))]
        # Odd in each tangential direction that names just one of load and displacement.
        if (row == X) != (column == X):
            values *= np.sign(lags_x)
        if (row == Y) != (column == Y):
            values *= np.sign(lags_y)[:, None]
        return values

    def _quadrant(self, row: int, column: int, squares: "_Squares") -> Floats:
        """Return the coefficients at lags 0 .. n - 1, shape (ny, nx)."""
        mu, nu = self.half_space.shear_modulus_pascal, self.half_space.poisson_ratio
        if row == column == Z:
            return (1.0 - nu) / (2.0 * np.pi * mu) * (squares.xx + squares.yy)
        if row == column:
            along, across = squares.xx, squares.yy
            if row == Y:
                along, across = across, along
            return (along + (1.0 - nu) * across) / (2.0 * np.pi * mu)
        if Z not in (row, column):
            return nu / (2.0 * np.pi * mu) * squares.xy
        sign = -1.0 if column == Z else 1.0  # a normal load draws the surface in, a tangential one lowers it ahead
        slope = squares.x if X in (row, column) else squares.y
        return sign * (1.0 - 2.0 * nu) / (4.0 * np.pi * mu) * slope


class _Squares:
    """Integrals over a square pixel, at lags 0 .. n - 1 from its centre, shape (ny, nx), in metres.

    Of x^2/r^3, y^2/r^3, x y/r^3, x/r^2 and y/r^2, each the difference over the corners of its primitive.
    """

    def __init__(self, shape: tuple[int, int], pitch_m: float) -> None:
        # In half pitches every corner is an odd number: none lies on an axis, where the primitives have no value.
        y, self._x = (2.0 * np.arange(n + 1) - 1.0 for n in shape)
        self._y = y[:, None]
        self._half_pitch_m = pitch_m / 2.0

    @cached_property
    def xx(self) -> Floats:
        return self._over_pixel(self._y * np.arcsinh(self._x / np.abs(self._y)))

    @cached_property
    def yy(self) -> Floats:
        return self._over_pixel(self._x * np.arcsinh(self._y / np.abs(self._x)))

    @cached_property
    def xy(self) -> Floats:
        return self._over_pixel(-np.hypot(self._x, self._y))

    @cached_property
    def x(self) -> Floats:
        return self._over_pixel(self._y * self._log_r + self._x * np.arctan(self._y / self._x))

    @cached_property
    def y(self) -> Floats:
        return self._over_pixel(self._x * self._log_r + self._y * np.arctan(self._x / self._y))

    @cached_property
    def _log_r(self) -> Floats:
        return np.asarray(np.log(np.hypot(self._x, self._y)), np.float64)

    def _over_pixel(self, primitive: Floats) -> Floats:
        return np.diff(np.diff(primitive, axis=0), axis=1) * self._half_pitch_m


class Convolution:
    """Convolution of images (columns, ny, nx) with real kernels to images (rows, ny, nx), by Fourier transform."""

    def __init__(self, kernel: Floats, shape: tuple[int, int]) -> None:
        """Transform a `kernel` (rows, columns, ky, kx) whose lags are in the order of the discrete transform."""
        self._shape = shape
        self._lengths = kernel.shape[-2:]
        self._spectrum = fft.rfft2(kernel)

    def __call__(self, images: Floats) -> Floats:
        ny, nx = self._shape
        ky, kx = self._lengths
        # Transformed along x where rows hold something, and back where they are asked for.
        inputs = fft.fft(fft.rfft(images, kx), ky, axis=-2)
        outputs = np.einsum("rcyx,cyx->ryx", self._spectrum, inputs)
        return np.asarray(fft.irfft(fft.ifft(outputs, axis=-2)[:, :ny], kx)[..., :nx], np.float64)


class RoughStiffness:
    """Image times the modulus of its frequency: a compliance's inverse but for a factor and for what lies at the rim.

    The preconditioner of conjugate gradients with a `SurfaceCompliance`; linear, symmetric and positive.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        ky, kx = (fft.next_fast_len(n + n // 4 + 1, real=True) for n in shape)
        frequency = np.hypot(fft.rfftfreq(kx), fft.fftfreq(ky)[:, None])
        self._shape, self._lengths, self._frequency = shape, (ky, kx), frequency

    def __call__(self, images: Floats) -> Floats:
        """Transform images (..., ny, nx)."""
        ny, nx = self._shape
        stiff = fft.irfft2(self._frequency * fft.rfft2(images, self._lengths), self._lengths)
        return np.asarray(stiff[..., :ny, :nx], np.float64)


def _lags(count: int) -> Indices:
    """Return the indices of a window of `count` pixels, in the order of a transform without wrap."""
    length = fft.next_fast_len(2 * count - 1, real=True)
    lags = np.arange(length)
    lags[count:] -= length
    np.maximum(lags, 1 - count, out=lags)  # what the window never reaches
    return lags
