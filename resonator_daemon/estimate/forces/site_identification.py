"""Site identification by weighted least squares over the sites' codes, with gate, runner-up and overload."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Final, Literal, NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode, joined
from resonator_daemon.estimate.forces.code_fit import (
    RUNNER_UP_GAP,
    SITES_ALIKE,
    Code,
    CodeFit,
    Codes,
    Explanation,
    Reading,
    detected_alone,
    explain_groups,
    fit_code,
    gates,
    join,
    leave_one_out,
    uncertainty_newton,
)

MODEL_ERROR: Final = 0.015  # relative error of K, independent from channel to channel
FORCE_MIN_FRACTION: Final = -0.02  # of the largest force: room for noise and for a held common mode
OVERLOAD_FACTOR: Final = 10.0  # times the largest force; further away, a foreign tone is likelier than a press
REACH_STD: Final = 10.0  # a code further away, on any channel, is neither a match nor a runner-up

_DISAGREE: Final = Reason(ReasonCode.CHANNELS_DISAGREE, "channels disagree on the force")
_OVERLOAD_OR_SEVERAL: Final = Reason(ReasonCode.OVERLOAD_OR_SEVERAL, "one force beyond the range, or several sites")

Status = Literal["ok", "ambiguous", "rejected", "overload"]


@dataclass(slots=True)  # not frozen, which takes three times as long to make: several for each reading
class SiteForce:
    """Force on one site, an index into the plate's sites; under `overload` it is a lower bound.

    `noise_newton`, one standard deviation, is that of counter and oscillator; `systematic_newton`, too, that of the
    sensitivities and of the held common mode. `unobserved_bound_newton` is the most that a touch next to the site may
    have put on other sites. `channels` are those that follow the site.
    """

    site: int
    force_newton: float
    noise_newton: float
    systematic_newton: float
    status: Literal["ok", "overload", "possibly_more", "uncalibrated", "no_signal"]
    at_least_newton: float | None = None
    unobserved_bound_newton: float = 0.0
    channels: tuple[int, ...] = ()


@dataclass(slots=True)  # not frozen, which takes three times as long to make: one for each reading
class Match:
    """Outcome of one reading of the channels: the sites found, or none with the reason.

    `chi2` is summed over the sites' fits.
    """

    status: Status
    reason: Reason | None
    chi2: float
    forces: tuple[SiteForce, ...] = ()


class Matcher:
    """Codes of a plate: per site and channel an unloaded frequency and a signed sensitivity.

    The shift is y_c = 1 - f0[m, c] / f_c = K[m, c] F + e_c. The covariance of e adds the counter's noise per channel,
    the oscillator's and the held common mode's over all channels, and (eps K F)^2 for the error of K: with noise alone
    most true touches would fail the gate. One site on all channels is tried first. Where none fits, a force beyond the
    range or channels that follow different sites must explain the reading, not both; where neither does, all channels
    but one may.
    """

    def __init__(
        self,
        f0_hz: Floats,
        sensitivity: Floats,
        force_max_newton: float,
        *,
        model_error: float = MODEL_ERROR,
        hidden_fraction: Floats | None = None,
    ) -> None:
        """Initialise with codes (m, channels), sensitivity in 1/N, and optionally `hidden_fraction` (m,) of `force`."""
        ends = force_max_newton * np.array([FORCE_MIN_FRACTION, 1.0, OVERLOAD_FACTOR])
        least, most, beyond = ends.tolist()
        sites = [Code(f0, k) for f0, k in zip(f0_hz.tolist(), sensitivity.tolist(), strict=True)]
        self._codes = Codes(sites, model_error, (least, most))
        self._beyond = Codes(sites, model_error, (most, beyond))
        loaded_hz = _loaded_hz(f0_hz[..., None], sensitivity[..., None] * ends)
        largest_shift = model_error * np.abs(sensitivity).max(axis=0)
        self._bands = _bands(loaded_hz[..., :2], (largest_shift * most) ** 2)
        self._bands_beyond = _bands(loaded_hz[..., 1:], (largest_shift * beyond) ** 2)
        self._hidden: list[float] = [0.0] * len(f0_hz) if hidden_fraction is None else hidden_fraction.tolist()
        self._gates = gates(f0_hz.shape[1])

    def match(
        self,
        frequency_hz: Sequence[float] | Floats,
        counter_std: Sequence[float] | Floats,
        oscillator_std: float,
        common_mode_std: float,
    ) -> Match:
        """Name the sites whose codes explain the channels' frequencies.

        Parameters
        ----------
        frequency_hz
            (channels,), common mode taken out; NaN, zero or negative for a channel that is not known.
        counter_std
            (channels,), relative, independent from channel to channel.
        oscillator_std
            Relative; all channels share one oscillator.
        common_mode_std
            Relative: what the common mode that was taken out may be off by, finite. While the common mode is not known
            there is nothing to match; 0 is for one that is known exactly.
        """
        reading = _reading(frequency_hz, counter_std, oscillator_std, common_mode_std)
        channels = reading.channels
        if (used := len(channels)) < 2:
            why = Reason(ReasonCode.TOO_FEW_CHANNELS, f"detected on {used} channel(s), at least 2 needed")
            return Match("rejected", why, math.nan)
        fits = _fits(self._codes, _near_all(self._bands, reading, channels), reading)
        if not fits or not fits[0].chi2 <= self._gates[used]:
            return self._apart(reading, fits[0].chi2 if fits else math.nan)
        best, *others = fits
        if others and others[0].score - best.score < RUNNER_UP_GAP:
            return Match("ambiguous", SITES_ALIKE, best.chi2)
        force = self._site_force(best, reading)
        if force.status == "overload":
            return Match("overload", self._overload_reason, best.chi2, (force,))
        return Match("ok", None, best.chi2, (force,))

    def _apart(self, reading: Reading, chi2: float) -> Match:
        """Explain a reading that no site within the range explains on all channels."""
        everywhere = range(len(self._codes.sites))
        near = {site for channel in reading.channels for site in _near(self._bands, reading, channel, everywhere)}
        detected = detected_alone(self._codes, sorted(near), reading)
        if set.intersection(*map(set, detected.values())):  # a chance excess of the gate is not read as anything else
            return Match("rejected", _DISAGREE, chi2)
        groups = explain_groups(self._codes, detected, reading)
        explanation, over = join(groups), self._overload(reading)
        if over and explanation.status != "rejected":
            return Match("ambiguous", _OVERLOAD_OR_SEVERAL, chi2)
        if over:
            return over
        if explanation.status == "rejected":
            explanation = leave_one_out(groups)
        return self._match_of(explanation, reading, chi2)

    def _match_of(self, explanation: Explanation, reading: Reading, chi2: float) -> Match:
        if not explanation.named:
            return Match(explanation.status, explanation.reason, chi2)
        forces = tuple([self._site_force(group.fit, reading) for group in explanation.named])
        chi2 = sum(group.fit.chi2 for group in explanation.named)
        if any(force.status == "overload" for force in forces):
            return Match("overload", joined(self._overload_reason, explanation.reason), chi2, forces)
        return Match("ok", explanation.reason, chi2, forces)

    def _overload(self, reading: Reading) -> Match | None:
        """Return the site that needs the least force beyond the range to explain all channels.

        A site whose channels are off by less, beyond the other end, contradicts it: all tones may be off together.
        """
        least, most = self._codes.range_newton
        channels = reading.channels
        gate = self._gates[len(channels)]
        fits = _fits(self._beyond, _near_all(self._bands_beyond, reading, channels), reading)
        over = [fit for fit in fits if fit.chi2 <= gate and fit.force_newton > most]
        if not over:
            return None
        fit = min(over, key=attrgetter("force_newton"))
        excess = fit.force_newton - most
        for code in self._codes.sites:
            alone = [
                (1.0 - code.f0_hz[channel] / reading.frequency_hz[channel]) / code.sensitivity[channel]
                for channel in channels
            ]
            if least - excess < min(alone) and max(alone) < most:
                return None
        return Match("overload", self._overload_reason, fit.chi2, (self._site_force(fit, reading),))

    @property
    def _overload_reason(self) -> Reason:
        return overload_reason(self._codes.range_newton[1])

    def _site_force(self, fit: CodeFit, reading: Reading) -> SiteForce:
        channels = tuple([channel for channel, weight in enumerate(fit.weights) if weight])
        largest = self._codes.range_newton[1]
        if fit.force_newton > largest:
            return SiteForce(fit.site, math.nan, math.nan, math.nan, "overload", largest, math.nan, channels)
        noise, systematic = uncertainty_newton(self._codes, fit.site, fit.force_newton, fit.weights, reading)
        hidden = self._hidden[fit.site] * abs(fit.force_newton)
        return SiteForce(
            fit.site, fit.force_newton, noise, systematic, "ok", unobserved_bound_newton=hidden, channels=channels
        )


def overload_reason(force_max_newton: float) -> Reason:
    """Return the reason of a force beyond the range of a plate."""
    return Reason(ReasonCode.OVERLOAD, f"force above {force_max_newton:g} N, the largest of this plate")


class _Band(NamedTuple):
    """Frequencies of the sites on one channel under the forces of a range, and the variance from the error of K."""

    low_hz: list[float]
    high_hz: list[float]
    model_variance: float


def _loaded_hz(f0_hz: Floats, shift: Floats) -> Floats:
    """Return f0 / (1 - y); any frequency, however high, belongs to a shift of 1 or more."""
    loaded: Floats = np.full(shift.shape, np.inf)
    np.divide(f0_hz, 1.0 - shift, out=loaded, where=shift < 1.0)
    return loaded


def _bands(loaded_hz: Floats, model_variance: Floats) -> list[_Band]:
    """Return the band of each channel from the frequencies (m, channels, 2) at the ends of a range of forces."""
    ends = loaded_hz.min(axis=2).T, loaded_hz.max(axis=2).T, model_variance
    return [_Band(*band) for band in zip(*(values.tolist() for values in ends), strict=True)]


def _near(bands: list[_Band], reading: Reading, channel: int, sites: Sequence[int]) -> list[int]:
    """Return those of the sites that a channel's frequency may belong to, as far as that channel shows."""
    low_hz, high_hz, model_variance = bands[channel]
    common_variance = reading.oscillator_variance + reading.common_mode_variance
    variance = reading.counter_variance[channel] + common_variance + model_variance
    slack, frequency = REACH_STD * math.sqrt(variance), reading.frequency_hz[channel]
    upper, lower = frequency * (1.0 + slack), frequency * (1.0 - slack)
    return [site for site in sites if low_hz[site] <= upper and high_hz[site] >= lower]


def _near_all(bands: list[_Band], reading: Reading, channels: Sequence[int]) -> Sequence[int]:
    """Return the sites that are near on all of the channels."""
    sites: Sequence[int] = range(len(bands[0].low_hz))
    for channel in channels:
        sites = _near(bands, reading, channel, sites)
    return sites


def _fits(codes: Codes, sites: Sequence[int], reading: Reading) -> list[CodeFit]:
    """Fit the sites on all channels in use, the best first."""
    fits = [fit_code(codes, site, reading) for site in sites]
    if len(fits) > 1:
        fits.sort(key=attrgetter("score"))
    return fits


def _reading(
    frequency_hz: Sequence[float] | Floats,
    counter_std: Sequence[float] | Floats,
    oscillator_std: float,
    common_mode_std: float,
) -> Reading:
    oscillator, common_mode = oscillator_std * oscillator_std, common_mode_std * common_mode_std
    if not math.isfinite(oscillator + common_mode):
        raise ValueError(f"oscillator_std {oscillator_std!r} and common_mode_std {common_mode_std!r} must be finite")
    known = [
        (f, std * std, 1.0 / (std * std)) if 0.0 < f < math.inf and 0.0 < std < math.inf else (1.0, 0.0, 0.0)
        for f, std in zip(frequency_hz, counter_std, strict=True)
    ]
    frequency, variance, inverse = map(list, zip(*known, strict=True))
    return Reading(frequency, variance, inverse, oscillator, common_mode)


class OverloadLatch:
    """Latch that holds an overload until the pilot returns or its sites are within their range.

    A force that grows past the range moves the tone onto the next site's code, where it would look like a light touch.
    """

    def __init__(self) -> None:
        self._held: Match | None = None

    def release(self) -> None:
        """Release the overload: the pilot has returned."""
        self._held = None

    def apply(self, match: Match) -> Match:
        """Return `match`, or the held overload if `match` does not name its sites."""
        if self._held and not {force.site for force in self._held.forces} <= {force.site for force in match.forces}:
            return self._held
        overloaded = tuple(force for force in match.forces if force.status == "overload")
        # Forces of other sites are those of this reading alone.
        self._held = replace(match, forces=overloaded) if overloaded else None
        return match
