"""Which site, and how hard: weighted least squares over the sites' codes, with gate, runner-up and overload."""

import math
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from resonator_daemon.measurement.baseline import COMMON_MODE_STD
from resonator_daemon.measurement.force import FloatArray, force_newton

CHI2_GATE: Final = {1: 10.83, 2: 13.82, 3: 16.27}  # 1e-3 exceeded by chance, per degree of freedom
RUNNER_UP_GAP: Final = 13.8  # twice the log of odds of 1000 : 1
MODEL_ERROR: Final = 0.015  # relative error of K, independent from channel to channel
FORCE_MIN_FRACTION: Final = -0.02  # of the largest force: room for noise and for a held common mode

MatchStatus = Literal["ok", "ambiguous", "rejected", "overload"]


@dataclass(frozen=True, slots=True)
class SiteForce:
    """Force on one site, an index into the plate's sites; under `overload` all that is known is a lower bound.

    `noise_newton` is one standard deviation from counter and oscillator. `systematic_newton` covers sensitivity error,
    the held common mode and, on a plate that shares load between sites, what a touch beside the site hides.
    """

    site: int
    force_newton: float
    noise_newton: float
    systematic_newton: float
    status: Literal["ok", "overload"]
    at_least_newton: float | None = None


@dataclass(frozen=True, slots=True)
class Match:
    """Outcome of one reading of the channels; `force` is absent where no site can be named."""

    status: MatchStatus
    reason: str
    chi2: float
    force: SiteForce | None


class _Fit(NamedTuple):
    """Least squares of every site at once; arrays over sites; F is `weights` (m, n) times the shifts."""

    force_newton: FloatArray
    chi2: FloatArray
    score: FloatArray
    weights: FloatArray


def _fit(sensitivity: FloatArray, shift: FloatArray, variance: FloatArray, common_variance: float) -> _Fit:
    """Fit F of shift = K F + e for R = diag(variance) + common_variance 11', inverted by Sherman and Morrison."""
    inverse = 1.0 / variance
    total = inverse.sum(axis=1, keepdims=True)
    common = common_variance / (1.0 + common_variance * total)
    k_r = inverse * sensitivity
    k_r -= common * inverse * k_r.sum(axis=1, keepdims=True)
    weights = k_r / (k_r * sensitivity).sum(axis=1, keepdims=True)
    force = (weights * shift).sum(axis=1)
    residual = shift - sensitivity * force[:, None]
    whitened = inverse * residual
    chi2 = (whitened * residual).sum(axis=1) - common[:, 0] * whitened.sum(axis=1) ** 2
    score = chi2 + np.log(variance).sum(axis=1) + np.log1p(common_variance * total[:, 0])
    return _Fit(force, chi2, score, weights)


class Matcher:
    """Codes of a plate: per site and channel an unloaded frequency and a signed sensitivity.

    The shift is y_c = 1 - f0[m, c] / f_c = K[m, c] F + e_c. The covariance of e adds the counter's noise per channel,
    the oscillator's and the held common mode's over all channels, and (eps K F)^2 for K known to 1.5 %: with noise
    alone most true touches would fail the gate.
    """

    def __init__(
        self,
        f0_hz: FloatArray,
        sensitivity: FloatArray,
        force_max_newton: float,
        *,
        hidden_fraction: FloatArray | None = None,
    ) -> None:
        """Take codes of shape (m, channels), sensitivity in 1/N, and optionally `hidden_fraction` (m,) of `force`."""
        if f0_hz.ndim != 2 or f0_hz.shape != sensitivity.shape:
            raise ValueError(
                f"f0_hz {f0_hz.shape} and sensitivity {sensitivity.shape} must have one shape (m, channels)"
            )
        if not (np.isfinite(f0_hz).all() and (f0_hz > 0).all()):
            raise ValueError("f0_hz must be finite and above 0")
        if not (np.isfinite(sensitivity).all() and (sensitivity != 0).all()):
            raise ValueError("sensitivity must be finite and not 0")
        if not (math.isfinite(force_max_newton) and force_max_newton > 0):
            raise ValueError(f"force_max_newton {force_max_newton} must be finite and above 0")
        self._f0_hz = f0_hz
        self._sensitivity = sensitivity
        self._max_newton = force_max_newton
        self._min_newton = FORCE_MIN_FRACTION * force_max_newton
        self._hidden = np.zeros(len(f0_hz)) if hidden_fraction is None else hidden_fraction

    def match(self, frequency_hz: FloatArray, counter_std: FloatArray, oscillator_std: float) -> Match:
        """Name the site whose code explains the channels' frequencies.

        Parameters
        ----------
        frequency_hz
            (channels,), common mode taken out; NaN, zero or negative for a channel that is not known.
        counter_std
            (channels,), relative, independent from channel to channel.
        oscillator_std
            Relative; one oscillator is heard by all channels.
        """
        used = np.isfinite(frequency_hz) & (frequency_hz > 0) & np.isfinite(counter_std) & (counter_std > 0)
        count = int(used.sum())
        if count < 2:
            return Match("rejected", f"heard on {count} channel(s), at least 2 needed", math.nan, None)
        f0_hz, sensitivity = self._f0_hz[:, used], self._sensitivity[:, used]
        noise_variance = counter_std[used] ** 2
        shift = 1.0 - f0_hz / frequency_hz[used]

        common_variance = oscillator_std**2 + COMMON_MODE_STD**2
        first = _fit(sensitivity, shift, np.broadcast_to(noise_variance, shift.shape), common_variance)
        variance = noise_variance + (MODEL_ERROR * sensitivity * first.force_newton[:, None]) ** 2
        fit = _fit(sensitivity, shift, variance, common_variance)

        gate = CHI2_GATE[count - 1]
        within = (fit.force_newton >= self._min_newton) & (fit.force_newton <= self._max_newton)
        order = np.argsort(np.where(within, fit.score, np.inf))
        best = int(order[0])
        if within[best] and fit.chi2[best] <= gate:
            chi2 = float(fit.chi2[best])
            if len(order) > 1 and within[order[1]] and fit.score[order[1]] - fit.score[best] < RUNNER_UP_GAP:
                return Match("ambiguous", f"sites {best} and {int(order[1])} explain it alike", chi2, None)
            force = self._site_force(best, fit, noise_variance, oscillator_std)
            return Match("ok", "", chi2, force)

        chi2 = float(fit.chi2[best]) if within[best] else math.nan
        alone = force_newton(f0_hz, frequency_hz[used], sensitivity)
        decodes = (alone >= self._min_newton) & (alone <= self._max_newton)
        if decodes.all(axis=1).any():  # a chance excess of the gate must not be read as a force beyond the range
            return Match("rejected", "channels disagree on the force", chi2, None)
        if decodes.any(axis=0).all():
            return Match("ambiguous", "channels hear different sites", chi2, None)
        over = np.flatnonzero((fit.force_newton > self._max_newton) & (fit.chi2 <= gate))
        if over.size:
            site = int(over[np.argmin(fit.force_newton[over])])  # the site that needs the least force for it
            reason = f"force above {self._max_newton:g} N, the largest of this plate"
            at_least = SiteForce(site, math.nan, math.nan, math.nan, "overload", self._max_newton)
            return Match("overload", reason, float(fit.chi2[site]), at_least)
        return Match("rejected", "no site explains the channels", chi2, None)

    def _site_force(self, site: int, fit: _Fit, noise_variance: FloatArray, oscillator_std: float) -> SiteForce:
        force, weights = float(fit.force_newton[site]), fit.weights[site]
        common = abs(float(weights.sum()))  # 1/|K| where K is equal on all channels
        noise = math.hypot(math.sqrt(float(weights**2 @ noise_variance)), oscillator_std * common)
        systematic = math.hypot(MODEL_ERROR * force, COMMON_MODE_STD * common, float(self._hidden[site]) * force)
        return SiteForce(site, force, noise, systematic, "ok")


class OverloadLatch:
    """Holds an overload until the pilot is heard again or the same site is back within its range.

    A force that grows past the range moves the tone onto the next site's code, where it would look like a light touch.
    """

    def __init__(self) -> None:
        self._held: Match | None = None

    def release(self) -> None:
        """Let go: the pilot is heard, nothing presses."""
        self._held = None

    def apply(self, match: Match) -> Match:
        if match.status == "overload":
            self._held = self._held or match
        elif self._held and match.force and self._held.force and match.force.site == self._held.force.site:
            self._held = None
        return self._held or match
