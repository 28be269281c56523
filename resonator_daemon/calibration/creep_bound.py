"""Creep that shows while loads stand: a bound for it where no model of creep is fitted."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.calibration.load_procedure import Loading, LoadProcedure
from resonator_daemon.forces.calibration_fit import CalibrationFit
from resonator_daemon.forces.loading_fit import RESPONSE_DEFAULT

SIGMAS: Final = 2.0  # of the pace, so that holds too short to show creep do not rule it out
CARRIED_ON_S: Final = math.exp(RESPONSE_DEFAULT[2])  # creep that begins at some pace and dies out goes on for its time


def creep_share(procedure: LoadProcedure, loadings: Sequence[Loading], fit: CalibrationFit) -> float:
    """Share of a force by which sites may creep on, at the pace of the holds, for as long as creep usually takes.

    The pace is the fastest that readings allow, of loads from zero on sites that `fit` has; NaN where there are none.
    """
    sites = fit.site.tolist()
    growth = [
        _pace(load, procedure, fit.sensitivity[sites.index(load.site)]) for load in loadings if load.site in sites
    ]
    pace, weight = np.array(growth).reshape(-1, 2).T
    if not weight.sum() > 0:
        return math.nan
    return (abs(float(weight @ pace / weight.sum())) + SIGMAS / math.sqrt(weight.sum())) * CARRIED_ON_S


def _pace(loading: Loading, procedure: LoadProcedure, sensitivity: Floats) -> tuple[float, float]:
    """Return how fast the reading grows, 1/s of the force, and the inverse of its variance."""
    lever = loading.times_s - loading.times_s.mean()
    by_channel = sensitivity / (sensitivity @ sensitivity)
    newton = loading.without_common_mode(procedure.untouched) @ by_channel
    common_newton = loading.oscillator_std * by_channel.sum()
    variance = common_newton**2 + (loading.std.mean(axis=0) * by_channel) @ (loading.std.mean(axis=0) * by_channel)
    spread = float(lever @ lever)
    force = loading.step.force_newton
    return float(lever @ newton) / spread / force, spread * force**2 / variance
