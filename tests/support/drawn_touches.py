"""Touches drawn at random, as frequencies with every error that the matcher's model names at its stated size."""

import numpy as np

from resonator_daemon.forces.site_identification import Matcher
from resonator_daemon.tones.frequency_estimators import oscillator_std

COUNTER_STD = np.full(4, 5e-10)
OSCILLATOR_STD = oscillator_std(0.01)
COMMON_MODE_STD = 2e-7
MODEL_ERROR = 0.015
NOISE = (COUNTER_STD, OSCILLATOR_STD, COMMON_MODE_STD)


def matcher_of(plate, **options):
    return Matcher(plate.f0_hz, plate.sensitivity, plate.force_max_newton, **options)


def draws(plate, count, seed, *, newton=(0.1, 9.0), model_error=MODEL_ERROR, noise=NOISE):
    """True sites (n,), forces (n,), frequencies (n, 4), with every error the model names drawn at its stated size."""
    rng = np.random.default_rng(seed)
    site, force = rng.integers(len(plate.f0_hz), size=count), rng.uniform(*newton, count)
    sensitivity = plate.sensitivity[site] * (1 + model_error * rng.normal(size=(count, 4)))
    counter_std, oscillator, common_mode = noise
    error = counter_std * rng.normal(size=(count, 4))
    error += oscillator * rng.normal(size=(count, 1)) + common_mode * rng.normal(size=(count, 1))
    # y = 1 - f0 / f, so f = f0 / (1 - y)
    return site, force, plate.f0_hz[site] / (1 - sensitivity * force[:, None] - error)


def wrong(matches, site):
    """How many of the readings name a site that is not the true one."""
    count = np.count_nonzero((matches.site >= 0) & (matches.site != site))
    several = [row for row, match in matches.apart.items() if len(match.forces) > 1]
    return count + sum(any(force.site != site[row] for force in matches.apart[row].forces) for row in several)


class Tuples:
    """Sixteen codes within 60 ppm: in a row with channels alike, in a row with pulled corners, or at random."""

    force_max_newton = 10.0

    def __init__(self, kind, seed=2):
        rng = np.random.default_rng(seed)
        offset = 60e-6 * np.arange(16)[:, None] * np.ones(4)
        if kind == "pulled":
            offset = offset + rng.uniform(-25e-6, 25e-6, (16, 4))
        elif kind == "random":
            offset = rng.uniform(0, 60e-6, (16, 4))
        self.f0_hz = 10e6 * (1 - offset)
        self.sensitivity = np.repeat(-6.3e-6 * rng.uniform(0.7, 1.3, (16, 1)), 4, axis=1)
