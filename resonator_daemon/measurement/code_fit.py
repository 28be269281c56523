"""The force that fits a site's code best on the channels that heard it, for many sites and readings at once."""

from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from resonator_daemon.measurement.force import FloatArray

GATE_PROBABILITY: Final = 1e-3  # of a true touch beyond the gate: 10.83, 13.82, 16.27 for 1, 2, 3 degrees of freedom
DOUBT_STD: Final = 3.0  # of the first fit's force: what it may fall short of the force that makes the model error
RUNNER_UP_GAP: Final = 13.8  # of scores: twice the log of odds of 1000 : 1


class Codes(NamedTuple):
    """Codes of m sites, (m, channels), K in 1/N, known to the relative `model_error`; and the range of forces."""

    f0_hz: FloatArray
    sensitivity: FloatArray
    model_error: float
    range_newton: tuple[float, float]


class Channels(NamedTuple):
    """Readings of the channels, (n, channels) and (n,); where one is not used, 1 Hz and variances of 0."""

    frequency_hz: FloatArray
    counter_variance: FloatArray
    inverse_variance: FloatArray
    oscillator_variance: FloatArray
    common_mode_variance: FloatArray

    @property
    def used(self) -> NDArray[np.bool_]:
        return self.inverse_variance > 0

    @property
    def common_variance(self) -> FloatArray:
        return self.oscillator_variance + self.common_mode_variance

    def rows(self, rows: slice) -> "Channels":
        return Channels(*(values[rows] for values in self))


class CodeFit(NamedTuple):
    """Fits of p codes, arrays (p,) and `weights` (p, channels): F is the sum of weights times shifts.

    `chi2` and `score` (chi2 + ln det R) are those of the force nearest to `force_newton` within the range.
    """

    force_newton: FloatArray
    chi2: FloatArray
    score: FloatArray
    weights: FloatArray


@cache
def gates(channels: int) -> FloatArray:
    """Largest chi2 of a fit on 0, 1, ... channels; on one, the ends of the range are all that it can exceed."""
    free = np.maximum(np.arange(channels + 1) - 1, 1)
    return np.array([chdtri(count, GATE_PROBABILITY) for count in free])


def fit_codes(
    codes: Codes,
    sites: NDArray[np.intp],
    frequency_hz: FloatArray,
    inverse_variance: FloatArray,
    common_variance: FloatArray,
) -> CodeFit:
    """Fit F of 1 - f0 / f = K F + e with R = diag(1 / inverse_variance + (eps K F)^2) + common_variance 11'.

    For p pairs of a site and a reading: `sites` and `common_variance` (p,), the others (p, channels); an inverse
    variance of 0 leaves a channel out. The F of the model error is that of a fit without it, held within the range, and
    three of its standard deviations: a light touch that the common mode makes look lighter would fail the gate.
    """
    sensitivity, (low, high) = codes.sensitivity[sites], codes.range_newton
    shift = 1.0 - codes.f0_hz[sites] / frequency_hz
    weights, information, _ = _weights(sensitivity, inverse_variance, common_variance)
    force = np.minimum(np.maximum(np.einsum("pc,pc->p", weights, shift), low), high)
    model_variance = codes.model_error**2 * (force * force + DOUBT_STD**2 / information)
    inverse = inverse_variance / (1.0 + inverse_variance * model_variance[:, None] * sensitivity * sensitivity)
    weights, _, common = _weights(sensitivity, inverse, common_variance)
    force = np.einsum("pc,pc->p", weights, shift)
    residual = shift - sensitivity * np.minimum(np.maximum(force, low), high)[:, None]
    whitened = inverse * residual
    # R inverted by Sherman and Morrison.
    chi2 = np.einsum("pc,pc->p", whitened, residual) - common * whitened.sum(axis=1) ** 2
    log_det = np.log1p(common_variance * inverse.sum(axis=1)) - np.log(np.where(inverse > 0, inverse, 1.0)).sum(axis=1)
    return CodeFit(force, chi2, chi2 + log_det, weights)


def _weights(
    sensitivity: FloatArray, inverse: FloatArray, common_variance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weights K'R^-1 / K'R^-1K for R = diag(1 / inverse) + v 11', K'R^-1K itself, and v / (1 + v 1'diag(inverse)1)."""
    common = common_variance / (1.0 + common_variance * inverse.sum(axis=1))
    whitened = inverse * sensitivity
    whitened -= (common * whitened.sum(axis=1))[:, None] * inverse
    information = np.einsum("pc,pc->p", whitened, sensitivity)
    return whitened / information[:, None], information, common


def uncertainty_newton(
    codes: Codes, sites: NDArray[np.intp], force_newton: FloatArray, weights: FloatArray, readings: Channels
) -> tuple[FloatArray, FloatArray]:
    """Noise and systematic standard deviation of p forces, one for each of the p `readings`.

    Noise is that of counter and oscillator. Systematic are the error of K, independent from channel to channel, and
    the held common mode, which nearly cancels where signs of K are mixed.
    """
    together = weights.sum(axis=1) ** 2
    noise = np.einsum("pc,pc->p", weights**2, readings.counter_variance) + together * readings.oscillator_variance
    spread = ((weights * codes.sensitivity[sites]) ** 2).sum(axis=1)
    systematic = (codes.model_error * force_newton) ** 2 * spread + together * readings.common_mode_variance
    return np.sqrt(noise), np.sqrt(systematic)
