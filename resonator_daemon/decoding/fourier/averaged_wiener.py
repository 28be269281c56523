"""Wiener inverses under several priors, averaged by how likely each makes the signals."""

from collections.abc import Sequence

import numpy as np
from scipy.special import logsumexp

from resonator_daemon.arrays import Complexes, Floats
from resonator_daemon.decoding.fourier.wiener import Estimate, SpectralWiener

_NEGLIGIBLE = 1e-4  # weight of an inverse that is left out


class AveragedWiener:
    """Posterior mean and variance where one of several priors, each as likely as the others, is the true one.

    Parameters
    ----------
    wieners
        One inverse for each prior, all with the same noise.
    samples_share
        Samples measured over those transformed: the likelihood counts for so much, as repeated samples tell nothing.
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
