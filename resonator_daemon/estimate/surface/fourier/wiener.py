"""The multivariate Wiener inverse in the eigenbasis of each frequency, its prior's scale chosen by likelihood."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from resonator_daemon.base.arrays import Complexes, Floats, Indices

_NEGLIGIBLE = 1e-4  # weight of an inverse that is left out of an average

_Number = TypeVar("_Number", np.float64, np.complex128)


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
