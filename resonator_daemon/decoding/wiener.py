"""The multivariate Wiener inverse in the eigenbasis of each frequency, its prior's scale chosen by likelihood."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_Number = TypeVar("_Number", np.float64, np.complex128)


@dataclass(frozen=True)
class Fit:
    """One frame in the eigenbasis, and the scale that explains it best."""

    rotated: Complexes  # (3, bins)
    scale: int  # index in the bank
    chi2: float  # mean square of the innovation in units of prior and declared noise
    excess: float  # noise variance over the declared one, at least 1
    log_evidence: float


class SpectralWiener:
    """Estimate f from s = T f + n for independent frequencies, with covariances q P of f and N of n, both diagonal.

    Karason, Srinivasan and Annaswamy, eq. (5), in the form that holds for any N: f = q P T* (q T P T* + N)^-1 s. With
    N^-1/2 T P^1/2 = U S V*, it is f = P^1/2 V (q S / (q S^2 + 1)) U* N^-1/2 s, for each q of a bank at no more cost.

    Parameters
    ----------
    forward
        T, shape (ny, nx // 2 + 1, 3, 3), in the layout of a unitary `rfft2`.
    prior_std, noise_std
        Square roots of P and N, shape (ny, nx // 2 + 1, 3).
    multiplicity
        Bins of the whole transform that each column stands for, shape (nx // 2 + 1,).
    bank
        Candidates for q, increasing.
    """

    def __init__(
        self, forward: Complexes, prior_std: Floats, noise_std: Floats, multiplicity: Floats, bank: Floats
    ) -> None:
        whitened = forward / noise_std[..., :, None] * prior_std[..., None, :]
        left, singular, right = np.linalg.svd(whitened)
        self._rotate = _bins_last(left.conj().swapaxes(-1, -2) / noise_std[..., None, :])
        self._to_signals = _bins_last(left * noise_std[..., :, None])
        self._to_tractions = _bins_last(right.conj().swapaxes(-1, -2) * prior_std[..., :, None])
        self._singular = _bins_last(singular)
        self._bank = bank
        self._weight = np.broadcast_to(multiplicity, forward.shape[:2]).ravel().copy()

        power = bank[:, None, None] * self._singular**2 + 1.0  # of the whitened signals: (bank, 3, bins)
        self._shrinkage = 1.0 / power
        self._samples = self._weight.sum()
        self._log_det = (self._weight * np.log(power)).sum(axis=(1, 2)) + (
            3.0 * self._samples * np.log(2.0 * np.pi)
            + 2.0 * (self._weight[:, None] * np.log(noise_std).reshape(-1, 3)).sum()
        )
        # Variances also far below the bank, for places around which signals are missing.
        self._levels = np.union1d(bank[0] * np.geomspace(1e-6, 0.5, 20), bank)
        share = np.abs(self._to_tractions) ** 2 * self._weight / self._samples
        left_over = 1.0 / (self._levels[:, None, None] * self._singular**2 + 1.0)
        self._variance = self._levels[:, None] * np.einsum("imb,kmb->ki", share, left_over)

    def fit(self, spectrum: Complexes, known_share: float) -> Fit:
        """Choose the scale for signals of shape (3, bins), of which `known_share` were measured and not filled in.

        Whittle's likelihood, the frequencies taken as independent, maximised over the bank and over a common factor of
        prior and noise that is at least 1.
        """
        rotated = (self._rotate * spectrum).sum(axis=1)
        energy = self._weight * (rotated.real**2 + rotated.imag**2)
        innovation = self._shrinkage.reshape(self._bank.size, -1) @ energy.ravel()
        count = 3.0 * self._samples * known_share
        chi2 = innovation / count
        excess = np.maximum(chi2, 1.0)
        deviance = known_share * self._log_det + count * np.log(excess) + innovation / excess
        scale = int(deviance.argmin())
        return Fit(rotated, scale, float(chi2[scale]), float(excess[scale]), -0.5 * float(deviance[scale]))

    def tractions(self, fit: Fit) -> Complexes:
        """Estimate of f, shape (3, bins)."""
        gain = self._bank[fit.scale] * self._singular * self._shrinkage[fit.scale]
        return np.asarray((self._to_tractions * (gain * fit.rotated)).sum(axis=1), np.complex128)

    def signals(self, fit: Fit) -> Complexes:
        """T f of the estimate, shape (3, bins)."""
        gain = 1.0 - self._shrinkage[fit.scale]
        return np.asarray((self._to_signals * (gain * fit.rotated)).sum(axis=1), np.complex128)

    def traction_variance(self, fit: Fit, density: Floats) -> Floats:
        """Posterior variance of each component in space, shape (3, *density.shape).

        From the covariance q P - q P T* (q T P T* + N)^-1 T q P. `density` is the share of signals known around a
        place: the noise there counts as larger by its inverse, up to the prior's own variance where none is known.
        """
        chosen = self._bank[fit.scale]
        reduced = np.maximum(chosen * density, self._levels[0])
        known = [np.interp(np.log(reduced), np.log(self._levels), np.log(variance)) for variance in self._variance.T]
        return np.asarray(fit.excess * chosen / reduced * np.exp(known), np.float64)


def _bins_last(matrices: NDArray[_Number]) -> NDArray[_Number]:
    """Move (ny, nx // 2 + 1, ...) to (..., bins), contiguous."""
    return np.ascontiguousarray(np.moveaxis(matrices.reshape(-1, *matrices.shape[2:]), 0, -1))
