"""The multivariate Wiener inverse in the eigenbasis of each frequency, its prior's scale chosen by likelihood.

With it the power spectra that serve as its prior, and the transform of an array to them: the array is extended beyond
its border, so that the period of a Fourier transform does less harm.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.special import logsumexp

from resonator_daemon.base.arrays import Complexes, Floats, Indices
from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.surface.skin import Prior

Spectra = Callable[[Floats, Floats], NDArray[np.inexact[Any]]]
"""Of omega_x (nx,) and omega_y (ny, 1) in rad/m: powers of x, y, z (ny, nx, 3), or matrices (ny, nx, 3, 3)."""

_ROUNDING = 1e-12  # eigenvalues below this share of the largest are those of a singular matrix

ExtensionName = Literal["taper", "periodic"]

_NEGLIGIBLE = 1e-4  # weight of an inverse that is left out of an average

_Number = TypeVar("_Number", np.float64, np.complex128)


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


@dataclass(frozen=True)
class Fit:
    """Frames in the eigenbasis, and for each the scale that explains it best."""

    rotated: Complexes  # (n, 3, bins)
    scale: Indices  # (n,): index in the scales
    chi2: Floats  # (n,): mean square of the innovation in units of prior and declared noise
    excess: Floats  # (n,): noise variance over the declared one, at least 1
    log_evidence: Floats  # (n,)


@dataclass(frozen=True)
class Estimate:
    """Posterior of frames of one stack."""

    tractions: Complexes  # (n, 3, bins): mean
    variance: Floats  # (n, 3, ...): in space
    chi2: Floats  # (n,)
    log_evidence: Floats  # (n,)


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
        R, of the same shape.
    noise_std
        Square root of N, shape (ny, nx // 2 + 1, 3).
    multiplicity
        Bins of the whole transform that each column stands for, shape (nx // 2 + 1,).
    scales
        Candidates for q, increasing.
    """

    def __init__(
        self, forward: Complexes, prior_root: Complexes, noise_std: Floats, multiplicity: Floats, scales: Floats
    ) -> None:
        bases = np.linalg.svd(forward / noise_std[..., :, None] @ prior_root)
        left, right = np.asarray(bases.U, np.complex128), np.asarray(bases.Vh, np.complex128)
        self._rotate = _bins_last(left.conj().swapaxes(-1, -2) / noise_std[..., None, :])
        self._to_signals = _bins_last(left * noise_std[..., :, None])
        self._to_tractions = _bins_last(prior_root @ right.conj().swapaxes(-1, -2))
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

    def estimate(self, spectrum: Complexes, known_share: float, density: Floats) -> Estimate:
        """Decode signals (n, 3, bins) of which a share was measured; `density` as in `traction_variance`."""
        fit = self.fit(spectrum, known_share)
        return Estimate(self.tractions(fit), self.traction_variance(fit, density), fit.chi2, fit.log_evidence)

    def fit(self, spectrum: Complexes, known_share: float) -> Fit:
        """Choose the scales for signals of shape (n, 3, bins), of which `known_share` were measured, not filled in.

        Whittle's likelihood, the frequencies taken as independent, is maximised over the scales and over a common
        factor of prior and noise that is at least 1.
        """
        rotated = product(self._rotate, spectrum)
        energy = self._weight * (rotated.real**2 + rotated.imag**2)
        innovation = energy.reshape(len(energy), -1) @ self._shrinkage.reshape(self._scales.size, -1).T
        count = 3.0 * self._samples * known_share
        chi2 = innovation / count
        excess = np.maximum(chi2, 1.0)
        deviance = known_share * self._log_det + count * np.log(excess) + innovation / excess
        scale = deviance.argmin(axis=1)
        best = np.arange(len(scale)), scale
        return Fit(rotated, scale, chi2[best], excess[best], -0.5 * deviance[best])

    def tractions(self, fit: Fit) -> Complexes:
        """Return the estimates of f, shape (n, 3, bins)."""
        gain = self._scales[fit.scale, None, None] * self._singular * self._shrinkage[fit.scale]
        return product(self._to_tractions, fit.rotated * gain)

    def signals(self, fit: Fit) -> Complexes:
        """T f of the estimates, shape (n, 3, bins)."""
        return product(self._to_signals, fit.rotated * (1.0 - self._shrinkage[fit.scale]))

    def mean_square(self, spectra: Complexes) -> Floats:
        """Return the mean square in space of spectra (..., bins)."""
        energy = self._weight * (spectra.real**2 + spectra.imag**2)
        return np.asarray(energy.sum(axis=-1) / self._samples, np.float64)

    def traction_variance(self, fit: Fit, density: Floats) -> Floats:
        """Posterior variance of each component in space, shape (n, 3, *density.shape).

        From the covariance q P - q P T* (q T P T* + N)^-1 T q P. `density` is the share of signals known around a
        place: the noise there counts as larger by its inverse, up to the prior's own variance where none is known.
        """
        by_frame = (-1, *[1] * (density.ndim + 1))
        chosen = self._scales[fit.scale].reshape(by_frame)
        reduced = np.maximum(chosen * density, self._levels[0])
        known = [np.interp(np.log(reduced), np.log(self._levels), np.log(variance)) for variance in self._variance.T]
        return np.asarray(
            fit.excess.reshape(by_frame) * chosen / reduced * np.exp(np.concatenate(known, axis=1)), np.float64
        )


class AveragedWiener:
    """Posterior mean and variance where one of several priors, each as likely as the others, is the true one.

    Parameters
    ----------
    wieners
        One inverse for each prior, all with the same noise.
    samples_share
        Samples measured over those transformed: the likelihood counts for so much, as repeated samples add nothing.
    """

    def __init__(self, wieners: Sequence[SpectralWiener], samples_share: float) -> None:
        self._wieners = wieners
        self._samples_share = samples_share

    def estimate(self, spectrum: Complexes, known_share: float, density: Floats) -> Estimate:
        """Decode as `SpectralWiener` does; the variance includes the array's mean square difference of the priors."""
        fits = [wiener.fit(spectrum, known_share) for wiener in self._wieners]
        evidence = self._samples_share * np.array([fit.log_evidence for fit in fits])
        total = logsumexp(evidence, axis=0)
        weights = np.exp(evidence - total)
        weights[weights < _NEGLIGIBLE] = 0.0
        weights /= weights.sum(axis=0)

        likely = np.flatnonzero(weights.any(axis=1)).tolist()
        tractions = np.array([self._wieners[index].tractions(fits[index]) for index in likely])
        variances = np.array([self._wieners[index].traction_variance(fits[index], density) for index in likely])
        shares = weights[likely]
        mean = np.einsum("kn,knib->nib", shares, tractions)
        between = np.einsum("kn,kni->ni", shares, self._wieners[0].mean_square(tractions - mean))
        within = np.einsum("kn,kn...->n...", shares, variances)
        return Estimate(
            tractions=mean,
            variance=within + between.reshape(*between.shape, *[1] * density.ndim),
            chi2=np.einsum("kn,kn->n", weights, np.array([fit.chi2 for fit in fits])),
            log_evidence=(total - np.log(len(fits))) / self._samples_share,
        )


def product(matrices: Complexes, vectors: Complexes) -> Complexes:
    """Apply (3, 3, bins) to each of (n, 3, bins)."""
    # Column by column: a product of all nine entries at once would leave the processor's cache.
    total = np.asarray(matrices[:, 0] * vectors[:, None, 0], np.complex128)
    for column in (1, 2):
        total += matrices[:, column] * vectors[:, None, column]
    return total


def _bins_last(matrices: NDArray[_Number]) -> NDArray[_Number]:
    """Move (ny, nx // 2 + 1, ...) to (..., bins), contiguous."""
    return np.ascontiguousarray(np.moveaxis(matrices.reshape(-1, *matrices.shape[2:]), 0, -1))
