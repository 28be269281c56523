"""From the force that a site feels to the force that presses: response taken out, and all that it may be off by."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.measurement.force import FloatArray
from resonator_daemon.measurement.force_sites import ForceSites
from resonator_daemon.measurement.site_response import ResponseInverse
from resonator_daemon.measurement.warm_contact import warming_std

# Of quartz force sensors whose response nobody has measured: half width of hysteresis, of the largest force, and creep.
USUAL_HYSTERESIS: Final = 0.01
USUAL_CREEP: Final = 0.005
PROVEN_HYSTERESES: Final = 4.0  # a press that large leaves a site where any press leaves it
RANGE_MARGIN: Final = 0.02  # of the largest calibrated force, before a force counts as outside


class Pressed(NamedTuple):
    """Forces (k,) that press, their noise and systematic standard deviations, and whether calibration covers them.

    `untold_newton` is what comes to the latter once it is known that something presses: hysteresis and creep that were
    not calibrated, a rest that is not known yet, and of sites that are heard untouched the warmth of a touch.
    """

    force_newton: FloatArray
    noise_newton: FloatArray
    systematic_newton: FloatArray
    untold_newton: FloatArray
    calibrated: NDArray[np.bool_]


class SiteErrors:
    """Follows every site's presses: hysteresis, creep, and how long something has lain on it."""

    def __init__(self, sites: ForceSites) -> None:
        self._sites = sites
        low, high = sites.valid_newton
        margin = RANGE_MARGIN * high if math.isfinite(high) else 0.0
        self._lowest_newton, self._highest_newton = low - margin, high + margin
        self.reset()

    def reset(self) -> None:
        """Forget all presses; what was before is not known."""
        response, count = self._sites.response, len(self._sites.positions_m)
        self._inverse = ResponseInverse(count, response, self._sites.force_max_newton) if response else None
        self._since_s = np.full(count, math.nan)
        self._silent = np.zeros(count, dtype=bool)
        self._unproven = np.zeros(count, dtype=bool)

    def rest(self, time_s: float) -> None:
        """Take that nothing presses any site now, and that what they feel so counts as nothing.

        How far a site still was from its rest shows once it is pressed by more than its hysteresis.
        """
        if self._inverse is not None:
            self._inverse.rest(np.arange(len(self._unproven)), time_s)
            self._unproven[:] = True

    def silence(self, time_s: float) -> None:
        """Take that nothing presses any site, and none is heard, until they are pressed again."""
        begun = np.flatnonzero(~self._silent)
        if begun.size and self._inverse is not None:
            self._inverse.release(begun, time_s)
        self._silent[:] = True
        self._since_s[:] = math.nan

    def press(
        self,
        sites: NDArray[np.intp],
        felt_newton: FloatArray,
        noise_newton: FloatArray,
        systematic_newton: FloatArray,
        newton_per_shift: FloatArray,
        time_s: float,
        touched: NDArray[np.bool_] | None = None,
    ) -> Pressed:
        """Take what sites (k,) feel now; those that are not `touched` are heard all the same, and rest.

        `systematic_newton` is what the felt force may be off by; to it come the response's share, the sensitivity's and
        that of a warm or cold touch, which `newton_per_shift` makes a force of.
        """
        since_s = self._since_s[sites]
        since_s = np.where(np.isnan(since_s), time_s, since_s)
        self._since_s[sites] = since_s if touched is None else np.where(touched, since_s, math.nan)
        self._silent[sites] = False
        force, noise, of_response, untold = felt_newton, noise_newton, np.zeros(len(sites)), np.zeros(len(sites))
        if self._inverse is None:
            untold = self.untold_newton(force)
        else:
            force, noise, of_response = self._inverse.press(sites, felt_newton, noise_newton, time_s)
            untold = self._unknown_rest(sites, force)
        warmth = self._sites.warmth
        held_s = time_s - since_s
        per_kelvin = warming_std(
            held_s,
            warmth.coefficients[sites, 0],
            1.0,
            transient_s=warmth.transient_s,
            relaxation_s=warmth.contact_time_s,
        )
        # The slope itself is not known better than that.
        unknown = warmth.coefficient_std * -np.expm1(-held_s / warmth.contact_time_s)
        warming = warmth.contact_std_kelvin[sites] * np.hypot(per_kelvin, unknown)
        if touched is not None:
            # What only a touch can do must not hide it.
            untold = np.hypot(untold, np.where(touched, warming, 0.0) * newton_per_shift)
            warming = np.zeros(len(sites))
        parts = systematic_newton, self._sites.sensitivity_std * force, warming * newton_per_shift, of_response
        systematic = np.sqrt(sum(part**2 for part in parts))
        calibrated = np.isnan(force) | ((force >= self._lowest_newton) & (force <= self._highest_newton))
        return Pressed(force, noise, systematic, untold, calibrated)

    def _unknown_rest(self, sites: NDArray[np.intp], force_newton: FloatArray) -> FloatArray:
        response = self._sites.response
        hysteresis = response.hysteresis_newton if response else 0.0
        unproven = self._unproven[sites]
        self._unproven[sites] = unproven & ~(force_newton > PROVEN_HYSTERESES * hysteresis)
        # Up to its hysteresis a site answers alike wherever it was at rest.
        beyond = np.clip(force_newton - hysteresis, 0.0, hysteresis) / 2.0
        return np.where(unproven, np.nan_to_num(beyond), 0.0)

    def untold_newton(self, force_newton: FloatArray) -> FloatArray:
        """Return what hysteresis and creep may make of a force, one standard deviation, where they are not known."""
        if self._inverse is not None:
            return np.zeros(force_newton.shape)
        # A site lags by half of its hysteresis, but by no more than presses it.
        lag = np.minimum(USUAL_HYSTERESIS * self._sites.force_max_newton / 2.0, np.abs(force_newton))
        return np.hypot(lag, USUAL_CREEP / 2.0 * force_newton)
