"""Hysteresis and creep of a site, and their inverse: the force that presses from the force felt."""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats, Indices

GAP_S: Final = 0.02  # a force is known between readings that are no further apart
DEAD_BAND: Final = 4.0  # of the noise: its largest excursion in some ten thousand readings

# Rows of all that is followed more than once.
_AS_IS, _HYSTERESIS_OFF, _FRACTION_OFF, _TIME_OFF, _LESS_BEFORE, _MORE_BEFORE = range(6)


@dataclass(frozen=True, slots=True)
class SiteResponse:
    """How a site feels a force F: F_e = (1 - c) (F + z) / 2 + c u, with a standard deviation of each parameter.

    z is the play operator, z <- clip(z, F - h, F + h), with h `hysteresis_newton`; u is creep, du/dt = (F - u) / tau,
    with c `creep_fraction` and tau `creep_time_s`.
    """

    hysteresis_newton: float
    creep_fraction: float
    creep_time_s: float
    hysteresis_std_newton: float
    creep_fraction_std: float
    creep_time_std_s: float


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
