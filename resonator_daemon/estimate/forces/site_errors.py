"""Force that presses from the force that a site feels: response inverted, with all systematic errors.

A contact that is warmer or colder than the plate changes its site's frequency. The site's temperature follows the
contact's with one time constant: dT(t) = D (1 - exp(-t / tau)) for a contact that differs from the plate by D, and what
is there at release decays alike. The relative shift is static and transient, a dT + a~ d(dT)/dt; the transient term is
that of Ballato, IEEE Trans. Sonics and Ultrasonics 26, 299 (1979). Only the spread of D is known, so the shift is a
standard deviation.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Bools, Floats, Indices
from resonator_daemon.estimate.forces.force_sites import ForceSites, SiteResponse

GAP_S: Final = 0.02  # a force is known between readings that are no further apart
DEAD_BAND: Final = 4.0  # of the noise: its largest excursion in some ten thousand readings

# Rows of all that is followed more than once.
_AS_IS, _HYSTERESIS_OFF, _FRACTION_OFF, _TIME_OFF, _LESS_BEFORE, _MORE_BEFORE = range(6)

# Of quartz force sensors whose response nobody has measured: half width of hysteresis, of the largest force, and creep.
DEFAULT_HYSTERESIS: Final = 0.01
DEFAULT_CREEP: Final = 0.005
PROVEN_HYSTERESES: Final = 4.0  # a press that large leaves a site where any press leaves it
RANGE_MARGIN: Final = 0.02  # of the largest calibrated force, before a force counts as outside


class Pressing(NamedTuple):
    """Forces that press, one for each site asked for.

    `systematic_newton` is one standard deviation from the response's parameters and from what pressed before the site
    was followed. The second part goes once the force has moved by 2 h in one direction, and with exp(-t / tau).
    """

    force_newton: Floats
    noise_newton: Floats
    systematic_newton: Floats


class ResponseInverse:
    """Inverse of play and creep of each site: the force that makes the site feel what was read.

    The same readings are followed six times: with the parameters as they are, with each of them off by its standard
    deviation, and as if the site had been pressed less or more before. How far these forces lie apart is the systematic
    uncertainty. A site's state is unknown at first, and again after `GAP_S` without a reading.
    """

    def __init__(self, sites: int, response: SiteResponse, force_max_newton: float) -> None:
        """Initialise; half of `force_max_newton` bounds what may have pressed while a site was not followed."""
        parameters = np.tile(
            [[response.hysteresis_newton], [response.creep_fraction], [response.creep_time_s]], (6, 1, 1)
        )
        parameters[_HYSTERESIS_OFF, 0] += response.hysteresis_std_newton
        parameters[_FRACTION_OFF, 1] += response.creep_fraction_std
        parameters[_TIME_OFF, 2] += response.creep_time_std_s
        self._hysteresis, self._fraction, self._time_s = parameters.swapaxes(0, 1)
        self._half = self._hysteresis / 2
        self._rest = 1.0 - self._fraction
        # Of a site that is only ever pressed, z at rest lies between 0 and h.
        self._unknown_rest = self._half.copy()
        self._unknown_rest[[_LESS_BEFORE, _MORE_BEFORE]] *= [[0.0], [2.0]]
        self._unknown_newton = force_max_newton / 2
        self._state = np.zeros((3, 6, sites))  # play, creep and force of the last reading
        self._last_s = np.full(sites, -math.inf)
        self._known_until_s = np.full(sites, -math.inf)

    def press(self, sites: Indices, felt_newton: Floats, noise_newton: Floats, time_s: float) -> Pressing:
        """Update with the forces that sites (k,), each named once, feel, with their noise; NaN gives NaN.

        `time_s` counts from anywhere, but from one place in all calls.
        """
        detected = np.isfinite(felt_newton)
        if not detected.all():
            result = np.full((3, len(sites)), math.nan)
            if detected.any():
                result[:, detected] = self.press(sites[detected], felt_newton[detected], noise_newton[detected], time_s)
            return Pressing(*result)
        play, creep = self._elapse(sites, time_s)
        mean = (felt_newton - self._fraction * creep) / self._rest  # of F and z
        play = np.where(np.isnan(play), mean, play)
        # F = 2 mean - z while z rests; a sliding z stays h behind F, so F lies h / 2 from their mean.
        from_mean = mean - play
        force = mean + np.minimum(np.maximum(from_mean, -self._half), self._half)
        # The largest of many noisy readings would drag z along.
        reach = self._hysteresis + DEAD_BAND * noise_newton
        self._keep(sites, np.minimum(np.maximum(play, force - reach), force + reach), creep, force, time_s)
        self._known_until_s[sites] = time_s + GAP_S
        gain = np.where(np.abs(from_mean[_AS_IS]) < self._half[_AS_IS], 2.0, 1.0) / self._rest[_AS_IS]
        off = (force[1:] - force[_AS_IS]) ** 2
        variance = off[:-2].sum(axis=0) + np.maximum(off[-2], off[-1])
        return Pressing(force[_AS_IS], gain * noise_newton, np.sqrt(variance))

    def rest(self, sites: Indices, time_s: float) -> None:
        """Tare sites (k,): they rest now, and what they feel counts as zero."""
        still = np.zeros((self._state.shape[1], len(sites)))
        self._keep(sites, still, still, still, time_s)
        self._known_until_s[sites] = math.inf

    def release(self, sites: Indices, time_s: float) -> None:
        """Mark sites (k,) as untouched from now until they are observed again."""
        play, creep = self._elapse(sites, time_s)
        play = np.where(np.isfinite(play), play, self._unknown_rest)
        play = np.minimum(np.maximum(play, -self._hysteresis), self._hysteresis)
        self._keep(sites, play, creep, np.zeros(play.shape), time_s)
        self._known_until_s[sites] = math.inf

    def _elapse(self, sites: Indices, time_s: float) -> tuple[Floats, Floats]:
        """Play and creep at `time_s`, each (6, k); where play is unknown, NaN, and infinite for less and more."""
        play, creep, force = self._state[:, :, sites]
        lost = time_s > self._known_until_s[sites]
        if lost.any():
            play[:, lost] = math.nan
            play[_LESS_BEFORE, lost], play[_MORE_BEFORE, lost] = -math.inf, math.inf
            force[_LESS_BEFORE, lost], force[_MORE_BEFORE, lost] = 0.0, self._unknown_newton
        # The force of the last reading is held: over GAP_S that is wrong by 40 uN for 8 N and the usual creep.
        return play, force + (creep - force) * np.exp((self._last_s[sites] - time_s) / self._time_s)

    def _keep(self, sites: Indices, play: Floats, creep: Floats, force: Floats, time_s: float) -> None:
        self._state[:, :, sites] = play, creep, force
        self._last_s[sites] = time_s


class PressedSites(NamedTuple):
    """Forces that press k sites, (k,), their noise and systematic standard deviations, and whether calibration covers.

    `unmodelled_newton` is added to the latter once something presses: hysteresis and creep that were not calibrated,
    an unknown rest, and the warmth of a touch. It must not hide a touch that causes it.
    """

    force_newton: Floats
    noise_newton: Floats
    systematic_newton: Floats
    unmodelled_newton: Floats
    calibrated: Bools


class SiteErrors:
    """Tracker of every site's presses: hysteresis, creep and duration."""

    def __init__(self, sites: ForceSites) -> None:
        self._sites = sites
        low, high = sites.valid_newton
        margin = RANGE_MARGIN * high if math.isfinite(high) else 0.0
        self._lowest_newton, self._highest_newton = low - margin, high + margin
        self.reset()

    def reset(self) -> None:
        """Discard all presses; the past is unknown."""
        response, count = self._sites.response, len(self._sites.positions_m)
        self._inverse = ResponseInverse(count, response, self._sites.force_max_newton) if response else None
        self._since_s = np.full(count, math.nan)
        self._all_silent = False
        self._unproven = np.zeros(count, dtype=bool)

    def rest(self, time_s: float) -> None:
        """Tare: nothing presses any site now, and what the sites feel counts as zero.

        How far a site still was from its rest shows once it is pressed by more than its hysteresis.
        """
        if self._inverse is not None:
            self._inverse.rest(np.arange(len(self._unproven)), time_s)
            self._unproven[:] = True

    def silence(self, time_s: float) -> None:
        """Mark all sites as untouched and unobserved until they are pressed again."""
        if self._all_silent:
            return
        if self._inverse is not None:
            self._inverse.release(np.arange(len(self._since_s)), time_s)
        self._all_silent = True
        self._since_s[:] = math.nan

    def press(
        self,
        sites: Indices,
        felt_newton: Floats,
        noise_newton: Floats,
        systematic_newton: Floats,
        newton_per_shift: Floats,
        time_s: float,
        touched: Bools,
    ) -> PressedSites:
        """Update with the forces that sites (k,), each named once, feel, NaN for unknown; those not `touched` rest.

        `systematic_newton` is what the felt force may be off by; to it come the response's share and the sensitivity's.
        `newton_per_shift` makes a force of the relative shift by a warm or cold touch.
        """
        since_s = np.where(np.isnan(self._since_s[sites]), time_s, self._since_s[sites])
        self._since_s[sites] = np.where(touched, since_s, math.nan)
        self._all_silent = False
        force, noise, of_response = felt_newton, noise_newton, np.zeros(len(sites))
        if self._inverse is None:
            unmodelled = self.unmodelled_newton(force)
        else:
            force, noise, of_response = self._inverse.press(sites, felt_newton, noise_newton, time_s)
            unmodelled = self._unknown_rest(sites, force)
        warmth = self._sites.warmth
        left = np.exp((since_s - time_s) / warmth.contact_time_s)  # of the difference between touch and site
        per_kelvin = warmth.coefficients[sites, 0] * (1.0 - left) + warmth.transient_s / warmth.contact_time_s * left
        unknown = warmth.coefficient_std * (1.0 - left)  # the slope itself is not known better than that
        warming = np.where(touched, warmth.contact_std_kelvin[sites] * np.hypot(per_kelvin, unknown), 0.0)
        of_sensitivity = self._sites.sensitivity_std * force
        systematic = np.sqrt(systematic_newton**2 + of_sensitivity**2 + of_response**2)
        calibrated = np.isnan(force) | ((force >= self._lowest_newton) & (force <= self._highest_newton))
        return PressedSites(force, noise, systematic, np.hypot(unmodelled, warming * newton_per_shift), calibrated)

    def _unknown_rest(self, sites: Indices, force_newton: Floats) -> Floats:
        response, unproven = self._sites.response, self._unproven[sites]
        hysteresis = response.hysteresis_newton if response else 0.0
        self._unproven[sites] = unproven & ~(force_newton > PROVEN_HYSTERESES * hysteresis)
        # Up to its hysteresis a site answers alike wherever it was at rest.
        beyond = np.clip(force_newton - hysteresis, 0.0, hysteresis) / 2.0
        return np.where(unproven, np.nan_to_num(beyond), 0.0)

    def unmodelled_newton(self, force_newton: Floats) -> Floats:
        """Return one standard deviation of forces from unknown hysteresis and creep."""
        if self._inverse is not None:
            return np.zeros(force_newton.shape)
        # A site lags by half of its hysteresis, but by no more than presses it.
        lag = np.minimum(DEFAULT_HYSTERESIS * self._sites.force_max_newton / 2.0, np.abs(force_newton))
        return np.hypot(lag, DEFAULT_CREEP / 2.0 * force_newton)
