"""Data of a calibration with known masses, and the forces that the sites felt."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats, Indices


@dataclass(frozen=True, eq=False, slots=True)
class Steps:
    """Every change of the load on a site, taking masses off included.

    `pressing` lists which masses lie on the site from `since_s` until the site's next step. `common_std` is the
    standard deviation, relative, of what shifts all channels alike for as long as the step lasts: the held common mode.
    """

    site: Indices  # (t,)
    since_s: Floats  # (t,)
    pressing: NDArray[np.bool_]  # (t, masses)
    common_std: Floats  # (t,)
    plate_kelvin: Floats  # (t,), NaN where not known


@dataclass(frozen=True, eq=False, slots=True)
class Readings:
    """Readings y = 1 - f0 / f against the plate file's f0, common mode taken out; only those with all channels.

    Both standard deviations are relative and independent from reading to reading: `noise_std` that of the counter, of
    each channel alone, `oscillator_std` of all channels alike.
    """

    step: Indices  # (n,)
    time_s: Floats  # (n,)
    shift: Floats  # (n, channels)
    noise_std: Floats  # (n, channels)
    oscillator_std: Floats  # (n,)

    def of_steps(self, wanted: NDArray[np.bool_]) -> "Readings":
        """Return the readings of the selected steps (t,)."""
        used = wanted[self.step]
        return Readings(
            self.step[used], self.time_s[used], self.shift[used], self.noise_std[used], self.oscillator_std[used]
        )


def felt_newton(
    steps: Steps,
    force_newton: Floats,
    readings: Readings,
    hysteresis_newton: float,
    creep_fraction: float,
    creep_time_s: float,
) -> Floats:
    """Force (n,) that the site felt at each reading, of steps of `force_newton` (t,) on sites that had rested.

    The model is that of SiteResponse. A step is sudden: play depends on where a force turns, not on how fast it moves.
    """
    play = np.zeros(len(steps.site))
    crept = np.zeros(len(steps.site))  # at the start of the step
    last: dict[int, int] = {}
    for step in np.argsort(steps.since_s, kind="stable").tolist():
        newton, z, u = float(force_newton[step]), 0.0, 0.0
        before = last.get(int(steps.site[step]))
        if before is not None:
            passed_s = float(steps.since_s[step] - steps.since_s[before])
            u = float(force_newton[before])
            u += (float(crept[before]) - u) * math.exp(-passed_s / creep_time_s)
            z = float(play[before])
        play[step] = min(max(z, newton - hysteresis_newton), newton + hysteresis_newton)
        crept[step] = u
        last[int(steps.site[step])] = step
    at = readings.step
    force = force_newton[at]
    creep = force + (crept[at] - force) * np.exp((steps.since_s[at] - readings.time_s) / creep_time_s)
    return (1.0 - creep_fraction) * (force + play[at]) / 2.0 + creep_fraction * creep
