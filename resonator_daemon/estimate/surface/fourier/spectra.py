"""Power spectra of surface tractions that serve a spectral decoder as its prior, and the transform to them.

An array is extended beyond its border, so that the period of a Fourier transform does less harm.
"""

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from resonator_daemon.base.arrays import Complexes, Floats
from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.surface.skin import Prior

Spectra = Callable[[Floats, Floats], NDArray[np.inexact[Any]]]
"""Of omega_x (nx,) and omega_y (ny, 1) in rad/m: powers of x, y, z (ny, nx, 3), or matrices (ny, nx, 3, 3)."""

_ROUNDING = 1e-12  # eigenvalues below this share of the largest are those of a singular matrix

ExtensionName = Literal["taper", "periodic"]


def spectra_of(prior: Prior) -> Spectra:
    """Return the power spectra of a prior."""

    def power(omega_x: Floats, omega_y: Floats) -> Floats:
        return np.asarray(prior.spectrum_m2(omega_x**2 + omega_y**2)[..., None] * prior.powers, np.float64)

    return power


def white(omega_x: Floats, omega_y: Floats) -> Floats:
    """Power 1 of each component at every frequency."""
    return np.ones((omega_y.size, omega_x.size, 3))


def sliding(spectra: Spectra, friction: float, direction_rad: float, sector_rad: float) -> Spectra:
    """Coulomb's law for a direction of f_t anywhere in a sector: the mean of v v^T P_fz, v = (mu cos, mu sin, 1).

    P_fz is the power of f_z in `spectra`. A sector of 0 ties f_x and f_y fully to f_z; one of 2 pi leaves the powers
    (mu^2 / 2, mu^2 / 2, 1) without any coupling. The matrix printed for an unknown direction, with both couplings at
    once, has a negative eigenvalue.
    """
    once, twice = np.sinc(sector_rad / (2.0 * np.pi)), np.sinc(sector_rad / np.pi)  # means of cos and of cos 2 phi
    x, y = friction * once * np.cos(direction_rad), friction * once * np.sin(direction_rad)
    half = friction**2 / 2.0
    cos, sin = half * twice * np.cos(2.0 * direction_rad), half * twice * np.sin(2.0 * direction_rad)
    moments = np.array([[half + cos, sin, x], [sin, half - cos, y], [x, y, 1.0]])

    def power(omega_x: Floats, omega_y: Floats) -> Floats:
        normal = _matrices("prior", spectra, omega_x, omega_y)[..., 2, 2].real
        return np.asarray(normal[..., None, None] * moments, np.float64)

    return power


def prior_root(spectra: Spectra, grid: SpectralGrid) -> Complexes:
    """Square root R of the spectra on a grid, P = R R*, scaled to unit variance of f_z in space.

    Shape (ny, nx // 2 + 1, 3, 3). As in a transfer matrix, a Nyquist frequency stands for both its signs.

    Raises
    ------
    ValueError
        Spectra of another shape, not finite, not those of a real field, no covariance, or without power of f_z.
    """
    nyquist_x = np.arange(grid.omega_x.size) * 2 == grid.shape[1]
    nyquist_y = np.arange(grid.shape[0])[:, None] * 2 == grid.shape[0]
    across = [grid.omega_x, np.where(nyquist_x, -grid.omega_x, grid.omega_x)]
    along = [grid.omega_y, np.where(nyquist_y, -grid.omega_y, grid.omega_y)]
    signs = [_matrices("prior", spectra, x, y) for x in across for y in along]
    mirrored = _matrices("prior", spectra, -grid.omega_x, -grid.omega_y).conj()
    if not np.allclose(signs[0], mirrored, rtol=1e-9, atol=0.0):
        raise ValueError("prior differs from its conjugate at -omega, must equal it: tractions are real")
    eigenvalues, vectors = np.linalg.eigh(np.mean(signs, axis=0))
    largest = eigenvalues[..., -1]
    if (eigenvalues[..., 0] < -1e-9 * np.abs(largest)).any():
        raise ValueError(f"prior has the eigenvalue {eigenvalues.min():.3g}, must have none below 0 to be a covariance")
    eigenvalues[eigenvalues < _ROUNDING * largest[..., None]] = 0.0
    root = vectors * np.sqrt(eigenvalues)[..., None, :]
    power = (grid.multiplicity * (np.abs(root[..., 2, :]) ** 2).sum(axis=-1)).sum()
    if power == 0.0:
        raise ValueError("prior has power 0 of f_z, must be above 0: its standard deviation is the scale")
    return np.asarray(root * np.sqrt(grid.shape[0] * grid.shape[1] / power), np.complex128)


def _matrices(name: str, spectra: Spectra, omega_x: Floats, omega_y: Floats) -> Complexes:
    """Evaluate to (ny, nx, 3, 3), Hermitian."""
    values = np.asarray(spectra(omega_x, omega_y))
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds values that are not finite, must be finite at every frequency")
    wanted = (omega_y.size, omega_x.size, 3)
    if values.shape == wanted:
        values = values[..., None] * np.eye(3)
    if values.shape != (*wanted, 3):
        raise ValueError(f"{name} has shape {values.shape}, must be {wanted} or {(*wanted, 3)}")
    if not np.allclose(values, values.conj().swapaxes(-1, -2), rtol=1e-9, atol=0.0):
        raise ValueError(f"{name} differs from its conjugate transpose, must be Hermitian")
    return np.asarray(values, np.complex128)


class ExtendedTransform:
    """Unitary Fourier transform of fields (..., ny, nx) that are extended first, and back.

    Parameters
    ----------
    shape
        (ny, nx) of the array.
    extension
        "taper", to a square of 1.5 times the longer side; "periodic", not at all.
    """

    def __init__(self, shape: tuple[int, int], extension: ExtensionName) -> None:
        self._shape = shape
        if extension == "taper":
            side = extended_length(max(shape))  # square: the displacement of an isolated load is known for that
            along, across = (extension_matrix(count, side) for count in shape)
        elif extension == "periodic":
            along, across = (np.eye(count) for count in shape)
        else:
            raise ValueError(f"extension is {extension!r}, must be 'taper' or 'periodic'")
        self.extended_shape = len(along), len(across)
        self._bins_x = len(across) // 2 + 1
        # Extension and transform in one matrix; that of x acts on real numbers, as real and imaginary columns.
        self._to_bins_y = np.asarray(fft.fft(along, axis=0, norm="ortho"), np.complex128)
        self._to_bins_x = np.ascontiguousarray(fft.rfft(across, axis=0, norm="ortho").T).view(np.float64)
        self.noise_power = noise_power(along)[:, None] * noise_power(across)[: self._bins_x]  # of unit white noise

    @property
    def samples_share(self) -> float:
        """Samples of the array over those transformed."""
        return self._shape[0] * self._shape[1] / (self.extended_shape[0] * self.extended_shape[1])

    def to_spectrum(self, fields: Floats) -> Complexes:
        """Return the bins of `rfft2` of the extended fields, flat: (..., bins)."""
        leading, (ny, nx) = fields.shape[:-2], self._shape
        rows = (fields.reshape(-1, nx) @ self._to_bins_x).view(np.complex128)
        spectrum = self._to_bins_y @ rows.reshape(*leading, ny, self._bins_x)
        return np.asarray(spectrum.reshape(*leading, -1), np.complex128)

    def to_space(self, spectrum: Complexes) -> Floats:
        """Return the fields (..., ny, nx) of the flat bins (..., bins), without what lies beyond the array."""
        ny, nx = self._shape
        columns = spectrum.reshape(*spectrum.shape[:-1], self.extended_shape[0], self._bins_x)
        rows = fft.ifft(columns, axis=-2, norm="ortho")[..., :ny, :]
        return np.asarray(fft.irfft(rows, n=self.extended_shape[1], norm="ortho")[..., :nx], np.float64)


def extended_length(count: int) -> int:
    """Even length of about 1.5 times `count` samples that transforms fast."""
    return 2 * fft.next_fast_len(-(-3 * count // 4), real=True)


def extension_matrix(count: int, length: int) -> Floats:
    """Return the matrix (length, count) that appends the last and the first sample, tapered to 0 by a cosine.

    Each taper is a quarter of the samples long, or half of what is free where that is less; the rest is 0.
    """
    free = length - count
    taper = min(-(-count // 4), free // 2)
    matrix = np.zeros((length, count))
    matrix[:count] = np.eye(count)
    weights = 0.5 + 0.5 * np.cos(np.pi * np.arange(1, taper + 1) / (taper + 0.5))
    matrix[count : count + taper, -1] = weights
    matrix[length - taper :, 0] += weights[::-1]
    return matrix


def noise_power(matrix: Floats) -> Floats:
    """Power (length,) of extended white noise of unit variance, in each bin of the unitary transform."""
    return np.asarray((np.abs(fft.fft(matrix, axis=0, norm="ortho")) ** 2).sum(axis=1), np.float64)
