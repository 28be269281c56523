"""Temperature of sites, and the frequency shift that it causes."""

from typing import NamedTuple

import numpy as np

from simulators.arrays import Floats
from simulators.relaxation import Relaxation


class SiteWarmth(NamedTuple):
    """Temperatures and what they do, each (n, sites)."""

    kelvin: Floats
    relative_shift: Floats


class SiteTemperature:
    """A site goes to the temperature of what surrounds or touches it: dT/dt = (T_s - T) / time.

    Its tone shifts by a d + b d^2 + c d^3 + e dT/dt, d = T - reference, relatively. All sites begin at the temperature
    that they are given first.

    Parameters
    ----------
    coefficients
        a, b and c (sites, 3), 1/K, 1/K^2, 1/K^3.
    transient_s
        e, relative shift for each K/s.
    reference_kelvin
        Where the shift is 0 at rest.
    time_s
        The time constant of a site.
    """

    def __init__(self, coefficients: Floats, transient_s: float, reference_kelvin: float, time_s: float) -> None:
        self._coefficients = coefficients
        self._transient_s = transient_s
        self._reference_kelvin = reference_kelvin
        self._time_s = time_s
        self._deviation: Relaxation | None = None

    def advance(self, dt_s: float, surroundings_kelvin: Floats, contact_kelvin: Floats) -> SiteWarmth:
        """Go on by n gates of dt_s each.

        Parameters
        ----------
        dt_s
            Length of a gate.
        surroundings_kelvin
            Temperature (n,) around the plate.
        contact_kelvin
            Temperature (n, sites) of what touches each site, NaN where that changes nothing.
        """
        around = (surroundings_kelvin - self._reference_kelvin)[:, np.newaxis]
        if self._deviation is None:
            self._deviation = Relaxation(self._time_s, np.full(contact_kelvin.shape[1], around[0, 0]))
        target = np.where(np.isnan(contact_kelvin), around, contact_kelvin - self._reference_kelvin)
        d = self._deviation.advance(dt_s, target)
        a, b, c = self._coefficients.T
        rate = (target - d) / self._time_s
        return SiteWarmth(self._reference_kelvin + d, ((c * d + b) * d + a) * d + self._transient_s * rate)
