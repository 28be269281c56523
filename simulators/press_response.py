"""Response of a site to its force: hysteresis and creep."""

import numpy as np

from simulators.arrays import Floats
from simulators.relaxation import Relaxation


class PressResponse:
    """F_e = (1 - c) (F + z) / 2 + c u of sites that were never pressed before.

    z is the play of half width h: it stays where it is until the force has gone further than h from it, and is then
    drawn along. u follows the force with one time constant: du/dt = (F - u) / time.

    Parameters
    ----------
    sites
        How many.
    half_width_newton
        h.
    creep_fraction
        c, the share of the force that comes late.
    creep_time_s
        The time constant of u.
    """

    def __init__(self, sites: int, half_width_newton: float, creep_fraction: float, creep_time_s: float) -> None:
        self._half_width_newton = half_width_newton
        self._creep_fraction = creep_fraction
        self._play_newton = np.zeros(sites)
        self._creep = Relaxation(creep_time_s, np.zeros(sites))

    def advance(self, dt_s: float, force_newton: Floats) -> Floats:
        """Return F_e (n, sites) in the next n gates of dt_s each, for the forces F (n, sites) in them."""
        felt = force_newton
        if self._half_width_newton:
            felt = 0.5 * (force_newton + self._play(force_newton))
        if self._creep_fraction:
            crept = self._creep.advance(dt_s, force_newton)
            felt = (1.0 - self._creep_fraction) * felt + self._creep_fraction * crept
        return felt

    def _play(self, force_newton: Floats) -> Floats:
        lowest = force_newton - self._half_width_newton
        highest = force_newton + self._half_width_newton
        play = np.empty_like(force_newton)
        before = self._play_newton
        for low, high, now in zip(lowest, highest, play, strict=True):
            np.minimum(np.maximum(before, low, out=now), high, out=now)
            before = now
        self._play_newton = before.copy()
        return play
