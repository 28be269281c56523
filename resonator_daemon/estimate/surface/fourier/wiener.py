"""The multivariate Wiener inverse in the eigenbasis of each frequency, its prior's scale chosen by likelihood.

With it the transform of an array to spectra: the array is extended beyond its border, so that the period of a Fourier
transform does less harm.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from resonator_daemon.base.arrays import Complexes, Floats

_Number = TypeVar("_Number", np.float64, np.complex128)


class ExtendedTransform:
    """Unitary Fourier transform of fields (..., ny, nx) that are extended to 1.5 times the longer side, and back."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        side = extended_length(max(shape))  # square: the displacement of an isolated load is known for that
        along, across = (extension_matrix(count, side) for count in shape)
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


@dataclass(frozen=True)
class Fit:
    """A frame in the eigenbasis, and the scale that explains it best."""

    rotated: Complexes  # (3, bins)
    scale: int  # index in the scales
    chi2: float  # mean square of the innovation in units of prior and declared noise
    excess: float  # noise variance over the declared one, at least 1
    log_evidence: float


class SpectralWiener:
    """Estimate f from s = T f + n for independent frequencies, with covariances q P of f and N of n, N diagonal.

    Karason, Srinivasan and Annaswamy, eq. (5), in the form that holds for any N: f = q P T* (q T P T* + N)^-1 s. With
    P = R R* and N^-1/2 T R = U S V*, it is f = R V (q S / (q S^2 + 1)) U* N^-1/2 s, for each q of a grid at no more
    cost.

    Parameters
    ----------
    forward
        T, shape (ny, nx // 2 + 1, 3, 3), in the layout of a unitary `rfft2`.
    prior_root
        R, diagonal, shape (ny, nx // 2 + 1, 3).
    noise_std
        Square root of N, shape (ny, nx // 2 + 1, 3).
    multiplicity
        Bins of the whole transform that each column stands for, shape (nx // 2 + 1,).
    scales
        Candidates for q, increasing.
    """

    def __init__(
        self, forward: Complexes, prior_root: Floats, noise_std: Floats, multiplicity: Floats, scales: Floats
    ) -> None:
        bases = np.linalg.svd(forward / noise_std[..., :, None] * prior_root[..., None, :])
        left, right = np.asarray(bases.U, np.complex128), np.asarray(bases.Vh, np.complex128)
        self._rotate = _bins_last(left.conj().swapaxes(-1, -2) / noise_std[..., None, :])
        self._to_signals = _bins_last(left * noise_std[..., :, None])
        self._to_tractions = _bins_last(prior_root[..., None] * right.conj().swapaxes(-1, -2))
        self._singular = _bins_last(np.asarray(bases.S, np.float64))
        self._scales = scales
        self._weight = np.broadcast_to(multiplicity, forward.shape[:2]).ravel().copy()

        power = scales[:, None, None] * self._singular**2 + 1.0  # of the whitened signals: (scales, 3, bins)
        self._shrinkage = 1.0 / power
        self._samples = self._weight.sum()
        self._log_det = (self._weight * np.log(power)).sum(axis=(1, 2)) + (
            3.0 * self._samples * np.log(2.0 * np.pi)
            + 2.0 * (self._weight[:, None] * np.log(noise_std).reshape(-1, 3)).sum()
        )
        # Variances also far below the scales, for places around which signals are missing.
        self._levels = np.union1d(scales[0] * np.geomspace(1e-6, 0.5, 20), scales)
        share = np.abs(self._to_tractions) ** 2 * self._weight / self._samples
        left_over = 1.0 / (self._levels[:, None, None] * self._singular**2 + 1.0)
        self._variance = self._levels[:, None] * np.einsum("imb,kmb->ki", share, left_over)

    def fit(self, spectrum: Complexes, known_share: float) -> Fit:
        """Choose the scale for signals of shape (3, bins), of which `known_share` were measured, not filled in.

        Whittle's likelihood, the frequencies taken as independent, is maximised over the scales and over a common
        factor of prior and noise that is at least 1.
        """
        rotated = product(self._rotate, spectrum)
        energy = self._weight * (rotated.real**2 + rotated.imag**2)
        innovation = self._shrinkage.reshape(self._scales.size, -1) @ energy.ravel()
        count = 3.0 * self._samples * known_share
        chi2 = innovation / count
        excess = np.maximum(chi2, 1.0)
        deviance = known_share * self._log_det + count * np.log(excess) + innovation / excess
        best = int(deviance.argmin())
        return Fit(rotated, best, float(chi2[best]), float(excess[best]), -0.5 * float(deviance[best]))

    def tractions(self, fit: Fit) -> Complexes:
        """Return the estimate of f, shape (3, bins)."""
        gain = self._scales[fit.scale] * self._singular * self._shrinkage[fit.scale]
        return product(self._to_tractions, fit.rotated * gain)

    def signals(self, fit: Fit) -> Complexes:
        """T f of the estimate, shape (3, bins)."""
        return product(self._to_signals, fit.rotated * (1.0 - self._shrinkage[fit.scale]))

    def traction_variance(self, fit: Fit, density: Floats) -> Floats:
        """Posterior variance of each component in space, shape (3, *density.shape).

        From the covariance q P - q P T* (q T P T* + N)^-1 T q P. `density` is the share of signals known around a
        place: the noise there counts as larger by its inverse, up to the prior's own variance where none is known.
        """
        chosen = self._scales[fit.scale]
        reduced = np.maximum(chosen * density, self._levels[0])
        known = [np.interp(np.log(reduced), np.log(self._levels), np.log(variance)) for variance in self._variance.T]
        return np.asarray(fit.excess * chosen / reduced * np.exp(np.array(known)), np.float64)


def product(matrices: Complexes, vectors: Complexes) -> Complexes:
    """Apply (3, 3, bins) to (3, bins), column by column: all nine entries at once would leave the processor's cache."""
    total = np.asarray(matrices[:, 0] * vectors[0], np.complex128)
    for column in (1, 2):
        total += matrices[:, column] * vectors[column]
    return total


def _bins_last(matrices: NDArray[_Number]) -> NDArray[_Number]:
    """Move (ny, nx // 2 + 1, ...) to (..., bins), contiguous."""
    return np.ascontiguousarray(np.moveaxis(matrices.reshape(-1, *matrices.shape[2:]), 0, -1))
