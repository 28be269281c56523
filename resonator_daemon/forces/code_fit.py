"""Least-squares force of a site's code on the channels that follow it, for many sites and readings at once."""

import math
import operator
from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.arrays import Floats

GATE_PROBABILITY: Final = 1e-3  # of a true touch beyond the gate: 10.83, 13.82, 16.27 for 1, 2, 3 degrees of freedom
DOUBT_STD: Final = 3.0  # of the first fit's force: what it may fall short of the force that makes the model error
RUNNER_UP_GAP: Final = 13.8  # of scores: twice the log of odds of 1000 : 1


class Codes(NamedTuple):
    """Codes of m sites, (m, channels), K in 1/N, known to the relative `model_error`; and the range of forces."""

    f0_hz: Floats
    sensitivity: Floats
    model_error: float
    range_newton: tuple[float, float]


class Reading(NamedTuple):
    """One reading of the channels, a row of `Channels` in plain floats."""

    frequency_hz: list[float]
    counter_variance: list[float]
    inverse_variance: list[float]
    oscillator_variance: float
    common_mode_variance: float


class Channels(NamedTuple):
    """Readings of the channels, (n, channels) and (n,); where one is not used, 1 Hz and variances of 0."""

    frequency_hz: Floats
    counter_variance: Floats
    inverse_variance: Floats
    oscillator_variance: Floats
    common_mode_variance: Floats

    @property
    def used(self) -> NDArray[np.bool_]:
        return self.inverse_variance > 0

    @property
    def common_variance(self) -> Floats:
        return self.oscillator_variance + self.common_mode_variance

    @property
    def first(self) -> Reading:
        """The first reading."""
        frequency, counter, inverse, oscillator, common_mode = (values[0].tolist() for values in self)
        return Reading(frequency, counter, inverse, oscillator, common_mode)

    def rows(self, rows: slice) -> "Channels":
        return Channels(*(values[rows] for values in self))


class CodeFit(NamedTuple):
    """Fits of p codes, arrays (p,) and `weights` (p, channels): F is the sum of weights times shifts.

    `chi2` and `score` (chi2 + ln det R) are those of the force nearest to `force_newton` within the range.
    """

    force_newton: Floats
    chi2: Floats
    score: Floats
    weights: Floats


@cache
def gates(channels: int) -> Floats:
    """Largest accepted chi2 of a fit on 0, 1, ... channels; on one channel only the range limits it."""
    return np.array([_gate(max(count - 1, 1)) for count in range(channels + 1)])


def _gate(freedom: int) -> float:
    """Return the chi2 that is exceeded with the probability of the gate.

    Written here, as closed forms hold for whole degrees of freedom: importing `scipy.special` takes 0.2 s.
    """
    low, high = 0.0, 100.0 * freedom
    while low < (middle := 0.5 * (low + high)) < high:
        half = 0.5 * middle
        tail = math.erfc(math.sqrt(half)) if freedom % 2 else 0.0
        powers = (0.5 * freedom - count for count in range(1, freedom // 2 + 1))
        tail += sum(half**power * math.exp(-half) / math.gamma(power + 1) for power in powers)
        low, high = (middle, high) if tail > GATE_PROBABILITY else (low, middle)
    return middle


def fit_codes(
    codes: Codes,
    sites: NDArray[np.intp],
    frequency_hz: Floats,
    inverse_variance: Floats,
    common_variance: Floats,
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


def _weights(sensitivity: Floats, inverse: Floats, common_variance: Floats) -> tuple[Floats, Floats, Floats]:
    """Weights K'R^-1 / K'R^-1K for R = diag(1 / inverse) + v 11', K'R^-1K itself, and v / (1 + v 1'diag(inverse)1)."""
    common = common_variance / (1.0 + common_variance * inverse.sum(axis=1))
    whitened = inverse * sensitivity
    whitened -= (common * whitened.sum(axis=1))[:, None] * inverse
    information = np.einsum("pc,pc->p", whitened, sensitivity)
    return whitened / information[:, None], information, common


class OneFit(NamedTuple):
    """Fit of one code to one reading; as a row of `CodeFit`."""

    site: int
    force_newton: float
    chi2: float
    score: float
    weights: list[float]


class Code(NamedTuple):
    """Code of one site, by channel."""

    f0_hz: list[float]
    sensitivity: list[float]


def fit_code(site: int, code: Code, model_error: float, range_newton: tuple[float, float], reading: Reading) -> OneFit:
    """Fit one site to one reading by the equations of `fit_codes`; for so few numbers arrays take ten times as long."""
    sensitivity, (low, high) = code.sensitivity, range_newton
    inverse_variance = reading.inverse_variance
    common_variance = reading.oscillator_variance + reading.common_mode_variance
    shift = [1.0 - f0 / f for f0, f in zip(code.f0_hz, reading.frequency_hz, strict=True)]
    weights, information, _ = _weights_of_one(sensitivity, inverse_variance, common_variance)
    first = _dot(weights, shift)
    force = low if first < low else high if first > high else first
    model_variance = model_error * model_error * (force * force + DOUBT_STD * DOUBT_STD / information)
    inverse = [i / (1.0 + i * model_variance * k * k) for i, k in zip(inverse_variance, sensitivity, strict=True)]
    weights, _, common = _weights_of_one(sensitivity, inverse, common_variance)
    force = _dot(weights, shift)
    within = low if force < low else high if force > high else force
    residual = [y - k * within for y, k in zip(shift, sensitivity, strict=True)]
    whitened = [i * r for i, r in zip(inverse, residual, strict=True)]
    together = sum(whitened)
    chi2 = _dot(whitened, residual) - common * together * together
    log_det = math.log1p(common_variance * sum(inverse)) - sum([math.log(i) for i in inverse if i > 0.0])
    return OneFit(site, force, chi2, chi2 + log_det, weights)


def _weights_of_one(
    sensitivity: list[float], inverse: list[float], common_variance: float
) -> tuple[list[float], float, float]:
    common = common_variance / (1.0 + common_variance * sum(inverse))
    shared = common * _dot(inverse, sensitivity)
    whitened = [i * (k - shared) for i, k in zip(inverse, sensitivity, strict=True)]
    information = _dot(whitened, sensitivity)
    return [w / information for w in whitened], information, common


def _dot(first: list[float], second: list[float]) -> float:
    total: float = sum(map(operator.mul, first, second))
    return total


def uncertainty_of_one(
    sensitivity: list[float], model_error: float, force_newton: float, weights: list[float], reading: Reading
) -> tuple[float, float]:
    """Noise and systematic standard deviation of one force; `uncertainty_newton` says of what."""
    together = sum(weights) ** 2
    squares = [w * w for w in weights]
    noise = _dot(squares, reading.counter_variance) + together * reading.oscillator_variance
    spread = sum([w * k * k for w, k in zip(squares, sensitivity, strict=True)])
    systematic = (model_error * force_newton) ** 2 * spread + together * reading.common_mode_variance
    return math.sqrt(noise), math.sqrt(systematic)


def uncertainty_newton(
    codes: Codes, sites: NDArray[np.intp], force_newton: Floats, weights: Floats, readings: Channels
) -> tuple[Floats, Floats]:
    """Noise and systematic standard deviation of p forces, one for each of the p `readings`.

    Noise is that of counter and oscillator. Systematic are the error of K, independent from channel to channel, and
    the held common mode, which nearly cancels where signs of K are mixed.
    """
    together = weights.sum(axis=1) ** 2
    noise = np.einsum("pc,pc->p", weights**2, readings.counter_variance) + together * readings.oscillator_variance
    spread = ((weights * codes.sensitivity[sites]) ** 2).sum(axis=1)
    systematic = (codes.model_error * force_newton) ** 2 * spread + together * readings.common_mode_variance
    return np.sqrt(noise), np.sqrt(systematic)
