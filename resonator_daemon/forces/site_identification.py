"""Site identification by weighted least squares over the sites' codes, with gate, runner-up and overload."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from resonator_daemon.arrays import Floats
from resonator_daemon.forces.channel_groups import Account, detected_alone, explain_groups, join, leave_one_out
from resonator_daemon.forces.code_fit import (
    RUNNER_UP_GAP,
    Channels,
    Code,
    Codes,
    Reading,
    fit_code,
    fit_codes,
    gates,
    uncertainty_newton,
    uncertainty_of_one,
)
from resonator_daemon.forces.force import force_newton

MODEL_ERROR: Final = 0.015  # relative error of K, independent from channel to channel
FORCE_MIN_FRACTION: Final = -0.02  # of the largest force: room for noise and for a held common mode
OVERLOAD_FACTOR: Final = 10.0  # times the largest force; further away, a foreign tone is likelier than a press
REACH_STD: Final = 10.0  # a code further away, on any channel, is neither a match nor a runner-up
BLOCK_ELEMENTS: Final = 1 << 18  # readings x sites x channels at once: what fits a processor's cache

Status = Literal["ok", "ambiguous", "rejected", "overload"]
STATUSES: Final[tuple[Status, ...]] = ("ok", "ambiguous", "rejected", "overload")
OK, AMBIGUOUS, REJECTED, OVERLOAD = range(4)


@dataclass(slots=True)  # not frozen, which takes three times as long to make: several for each reading
class SiteForce:
    """Force on one site, an index into the plate's sites; under `overload` it is a lower bound.

    `noise_newton`, one standard deviation, is that of counter and oscillator; `systematic_newton`, too, that of the
    sensitivities and of the held common mode. `hidden_newton` is the most that a touch beside the site may have put on
    other sites. `channels` are those that follow the site.
    """

    site: int
    force_newton: float
    noise_newton: float
    systematic_newton: float
    status: Literal["ok", "overload", "possibly_more", "uncalibrated", "no_signal"]
    at_least_newton: float | None = None
    hidden_newton: float = 0.0
    channels: tuple[int, ...] = ()


@dataclass(slots=True)  # not frozen, which takes three times as long to make: one for each reading
class Match:
    """Outcome of one reading of the channels: the sites found, or none with the reason.

    `candidates` are the sites between which an ambiguous reading cannot choose. `chi2` is summed over the sites' fits.
    """

    status: Status
    reason: str
    chi2: float
    forces: tuple[SiteForce, ...] = ()
    candidates: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Outcomes of n readings, arrays (n,): `status` indexes STATUSES, `site` is -1 and the others NaN where not known.

    `apart` has, by reading, the outcomes of those that no site explains on all channels; where these name one site, it
    stands in the arrays as well.
    """

    status: NDArray[np.int8]
    site: NDArray[np.int64]
    force_newton: Floats
    noise_newton: Floats
    systematic_newton: Floats
    chi2: Floats
    apart: Mapping[int, Match]


class _Best(NamedTuple):
    """Best site on all channels of n readings, arrays (n,) and `weights` (n, channels); `status` REJECTED for none."""

    status: NDArray[np.int8]
    site: NDArray[np.intp]
    rival: NDArray[np.intp]
    force_newton: Floats
    chi2: Floats
    weights: Floats


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
        if f0_hz.ndim != 2 or f0_hz.shape != sensitivity.shape or not len(f0_hz):
            raise ValueError(
                f"f0_hz {f0_hz.shape} and sensitivity {sensitivity.shape} must have one shape (m, channels), m >= 1"
            )
        if not (np.isfinite(f0_hz).all() and (f0_hz > 0).all()):
            raise ValueError("f0_hz must be finite and above 0")
        if not (np.isfinite(sensitivity).all() and (sensitivity != 0).all()):
            raise ValueError("sensitivity must be finite and not 0")
        if not (math.isfinite(force_max_newton) and force_max_newton > 0):
            raise ValueError(f"force_max_newton {force_max_newton} must be finite and above 0")
        if not 0 <= model_error < 1:
            raise ValueError(f"model_error {model_error} must be at least 0 and below 1")
        if hidden_fraction is not None and hidden_fraction.shape != f0_hz.shape[:1]:
            raise ValueError(f"hidden_fraction {hidden_fraction.shape} must be ({len(f0_hz)},), one for each site")
        ends = force_max_newton * np.array([FORCE_MIN_FRACTION, 1.0])
        self._codes = Codes(f0_hz, sensitivity, model_error, (float(ends[0]), float(ends[1])))
        self._beyond = self._codes._replace(range_newton=(force_max_newton, OVERLOAD_FACTOR * force_max_newton))
        loaded_hz = f0_hz[..., None] / (1.0 - sensitivity[..., None] * ends)
        self._low_hz, self._high_hz = loaded_hz.min(axis=2), loaded_hz.max(axis=2)
        self._model_variance = (model_error * force_max_newton * np.abs(sensitivity).max(axis=0)) ** 2
        self._hidden: list[float] = [0.0] * len(f0_hz) if hidden_fraction is None else hidden_fraction.tolist()
        self._gates: list[float] = gates(f0_hz.shape[1]).tolist()
        self._rows = [Code(f0, k) for f0, k in zip(f0_hz.tolist(), sensitivity.tolist(), strict=True)]
        bands = self._low_hz.T.tolist(), self._high_hz.T.tolist(), self._model_variance.tolist()
        self._bands: list[tuple[list[float], list[float], float]] = list(zip(*bands, strict=True))

    def match(
        self,
        frequency_hz: Sequence[float] | Floats,
        counter_std: Sequence[float] | Floats,
        oscillator_std: float,
        common_mode_std: float,
    ) -> Match:
        """Name the sites whose codes explain the channels' frequencies; `match_many` with one reading, (channels,)."""
        reading = _reading(frequency_hz, counter_std, oscillator_std, common_mode_std)
        used = sum([inverse > 0.0 for inverse in reading.inverse_variance])
        if used < 2:
            return Match("rejected", f"heard on {used} channel(s), at least 2 needed", math.nan)
        error, span = self._codes.model_error, self._codes.range_newton
        fits = [fit_code(site, self._rows[site], error, span, reading) for site in self._near_one(reading)]
        if len(fits) > 1:
            fits.sort(key=attrgetter("score"))
        if not fits or not fits[0].chi2 <= self._gates[used]:
            chi2 = fits[0].chi2 if fits else math.nan
            channels = self._channels(
                np.array([frequency_hz]), np.array([counter_std]), oscillator_std, common_mode_std
            )
            return self._apart(channels, chi2)
        best, *others = fits
        if others and others[0].score - best.score < RUNNER_UP_GAP:
            candidates = tuple(sorted((best.site, others[0].site)))
            return Match("ambiguous", "two sites explain the channels alike", best.chi2, (), candidates)
        force = self._site_force(best.site, best.force_newton, best.weights, reading)
        if best.force_newton > span[1]:
            return Match("overload", self._overload_reason, best.chi2, (force,))
        return Match("ok", "", best.chi2, (force,))

    def match_many(
        self,
        frequency_hz: Floats,
        counter_std: Floats,
        oscillator_std: ArrayLike,
        common_mode_std: ArrayLike,
    ) -> Matches:
        """Match n readings at once.

        Parameters
        ----------
        frequency_hz
            (n, channels), common mode taken out; NaN, zero or negative for a channel that is not known.
        counter_std
            Relative, independent from channel to channel; (n, channels) or (channels,).
        oscillator_std
            Relative; all channels share one oscillator. A number or (n,).
        common_mode_std
            Relative: what the common mode that was taken out may be off by, finite. A number or (n,). While the common
            mode is not known there is nothing to match; 0 is for one that is known exactly.
        """
        count = len(frequency_hz)
        block = max(1, BLOCK_ELEMENTS // self._codes.f0_hz.size)
        readings = self._channels(frequency_hz, counter_std, oscillator_std, common_mode_std)
        blocks = [self._best(readings.rows(slice(start, start + block))) for start in range(0, max(count, 1), block)]
        best = _Best(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))
        found = best.status == OK
        site = np.where(found | (best.status == OVERLOAD), best.site, -1)
        noise, systematic = uncertainty_newton(self._codes, site, best.force_newton, best.weights, readings)
        force, noise, systematic = (np.where(found, v, np.nan) for v in (best.force_newton, noise, systematic))
        matches = Matches(best.status, site, force, noise, systematic, best.chi2, apart := {})
        for row in np.flatnonzero(best.status == REJECTED):
            reading = readings.rows(slice(row, row + 1))
            match = apart[int(row)] = self._apart(reading, float(best.chi2[row]))
            matches.status[row], matches.chi2[row] = STATUSES.index(match.status), match.chi2
            if len(match.forces) == 1:
                (only,) = match.forces
                site[row], force[row] = only.site, only.force_newton
                noise[row], systematic[row] = only.noise_newton, only.systematic_newton
        return matches

    def _channels(
        self, frequency_hz: Floats, counter_std: Floats, oscillator_std: ArrayLike, common_mode_std: ArrayLike
    ) -> Channels:
        used = np.isfinite(frequency_hz) & (frequency_hz > 0) & np.isfinite(counter_std) & (counter_std > 0)
        variance = np.where(used, counter_std, 0.0) ** 2
        oscillator = np.zeros(len(used)) + np.square(oscillator_std)
        common = np.zeros(len(used)) + np.square(common_mode_std)
        if not np.isfinite(oscillator + common).all():
            raise ValueError(
                f"oscillator_std {oscillator_std!r} and common_mode_std {common_mode_std!r} must be finite"
            )
        inverse = np.where(used, 1.0 / np.where(used, variance, 1.0), 0.0)
        return Channels(np.where(used, frequency_hz, 1.0), variance, inverse, oscillator, common)

    def _near(self, readings: Channels) -> NDArray[np.bool_]:
        """(n, m, channels): codes that a channel's frequency may belong to, as far as that channel tells."""
        variance = readings.counter_variance + readings.common_variance[:, None] + self._model_variance
        slack, used = REACH_STD * np.sqrt(variance), readings.used
        upper = np.where(used, readings.frequency_hz * (1.0 + slack), np.inf)
        lower = np.where(used, readings.frequency_hz * (1.0 - slack), 0.0)
        near: NDArray[np.bool_] = (upper[:, None] >= self._low_hz) & (lower[:, None] <= self._high_hz)
        return near

    def _near_one(self, reading: Reading) -> Sequence[int]:
        """Sites that are near, as `_near` has it, on all channels of one reading that are used."""
        sites: Sequence[int] = range(len(self._rows))
        common_variance = reading.oscillator_variance + reading.common_mode_variance
        for (low_hz, high_hz, model_variance), frequency, variance, inverse in zip(
            self._bands, reading.frequency_hz, reading.counter_variance, reading.inverse_variance, strict=True
        ):
            if inverse > 0.0:
                slack = REACH_STD * math.sqrt(variance + common_variance + model_variance)
                upper, lower = frequency * (1.0 + slack), frequency * (1.0 - slack)
                sites = [site for site in sites if low_hz[site] <= upper and high_hz[site] >= lower]
        return sites

    def _best(self, readings: Channels) -> _Best:
        """Fit one site on all channels."""
        used = readings.used.sum(axis=1)
        best = _Best(
            np.full(len(used), REJECTED, dtype=np.int8),
            np.full(len(used), -1),
            np.full(len(used), -1),
            np.full(len(used), np.nan),
            np.full(len(used), np.nan),
            np.zeros(readings.frequency_hz.shape),
        )
        rows, sites = np.nonzero(self._near(readings).all(axis=2) & (used >= 2)[:, None])
        if not rows.size:
            return best
        fit = fit_codes(
            self._codes,
            sites,
            readings.frequency_hz[rows],
            readings.inverse_variance[rows],
            readings.common_variance[rows],
        )
        order = np.lexsort((fit.score, rows))
        new = np.concatenate(([True], rows[1:] != rows[:-1]))
        first, row = order[new], rows[new]
        best.site[row], best.chi2[row] = sites[first], fit.chi2[first]
        best.force_newton[row], best.weights[row] = fit.force_newton[first], fit.weights[first]
        if len(row) < len(rows):
            second = np.flatnonzero(new[:-1] & ~new[1:]) + 1  # in the order: next to the best of the same reading
            near = fit.score[order[second]] - fit.score[order[second - 1]] < RUNNER_UP_GAP
            best.rival[rows[second[near]]] = sites[order[second[near]]]
        accepted = best.chi2 <= gates(readings.frequency_hz.shape[1])[used]
        status = np.where(best.force_newton > self._codes.range_newton[1], OVERLOAD, OK)
        status[best.rival >= 0] = AMBIGUOUS
        best.status[accepted] = status[accepted]
        return best

    def _apart(self, reading: Channels, chi2: float) -> Match:
        """Explain one reading that no site within the range explains on all channels."""
        used = int(reading.used.sum())
        if used < 2:
            return Match("rejected", f"heard on {used} channel(s), at least 2 needed", math.nan)
        sites = np.flatnonzero((self._near(reading)[0] & reading.used[0]).any(axis=1))
        detected = detected_alone(self._codes, sites, reading)
        if detected[reading.used[0]].all(axis=0).any():  # a chance excess of the gate must not be read as anything else
            return Match("rejected", "channels disagree on the force", chi2)
        groups = explain_groups(self._codes, sites, detected, reading)
        account, over = join(groups), self._overload(reading)
        if over and account.status != "rejected":
            candidates = {site.site for site in account.named} | {force.site for force in over.forces}
            reason = "one force beyond the range, or several sites"
            return Match("ambiguous", reason, chi2, (), tuple(sorted(candidates.union(account.candidates))))
        if over:
            return over
        if account.status == "rejected":
            account = leave_one_out(groups)
        return self._match_of(account, reading, chi2)

    def _match_of(self, account: Account, reading: Channels, chi2: float) -> Match:
        if not account.named:
            return Match(account.status, account.reason, chi2, (), account.candidates)
        forces = [
            self._site_force(group.site, group.force_newton, group.weights.tolist(), reading.first)
            for group in account.named
        ]
        chi2 = sum(group.chi2 for group in account.named)
        if any(force.status == "overload" for force in forces):
            return Match("overload", f"{account.reason}; {self._overload_reason}", chi2, tuple(forces))
        return Match("ok", account.reason, chi2, tuple(forces))

    def _overload(self, reading: Channels) -> Match | None:
        """Return the site that needs the least force beyond the range to explain all channels.

        A site whose channels are off by less, beyond the other end, speaks against it: all tones may be off together.
        """
        count, channels = self._codes.f0_hz.shape
        fit = fit_codes(
            self._beyond,
            np.arange(count),
            np.broadcast_to(reading.frequency_hz, (count, channels)),
            np.broadcast_to(reading.inverse_variance, (count, channels)),
            np.broadcast_to(reading.common_variance, count),
        )
        least, most = self._codes.range_newton
        fits = (fit.chi2 <= self._gates[int(reading.used.sum())]) & (fit.force_newton > most)
        site = int(np.argmin(np.where(fits, fit.force_newton, np.inf)))
        if not fits[site]:
            return None
        excess = fit.force_newton[site] - most
        alone = force_newton(self._codes.f0_hz, reading.frequency_hz, self._codes.sensitivity)
        off_together = ((alone > least - excess) & (alone < most)) | ~reading.used
        if off_together.all(axis=1).any():
            return None
        force = self._site_force(site, float(fit.force_newton[site]), fit.weights[site].tolist(), reading.first)
        return Match("overload", self._overload_reason, float(fit.chi2[site]), (force,))

    @property
    def _overload_reason(self) -> str:
        return f"force above {self._codes.range_newton[1]:g} N, the largest of this plate"

    def _site_force(self, site: int, force_newton: float, weights: list[float], reading: Reading) -> SiteForce:
        channels = tuple([channel for channel, weight in enumerate(weights) if weight])
        largest = self._codes.range_newton[1]
        if force_newton > largest:
            return SiteForce(site, math.nan, math.nan, math.nan, "overload", largest, math.nan, channels)
        noise, systematic = uncertainty_of_one(
            self._rows[site].sensitivity, self._codes.model_error, force_newton, weights, reading
        )
        hidden = self._hidden[site] * abs(force_newton)
        return SiteForce(site, force_newton, noise, systematic, "ok", hidden_newton=hidden, channels=channels)


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
    frequency, variance, inverse = (list(part) for part in zip(*known, strict=True))
    return Reading(frequency, variance, inverse, oscillator, common_mode)
