"""Touches drawn at random, as frequencies with every error that the matcher's model names at its stated size."""

from typing import NamedTuple

import numpy as np

from resonator_daemon.estimate.forces.site_identification import Matcher
from resonator_daemon.estimate.tones.frequency_estimators import oscillator_std

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


class Outcomes(NamedTuple):
    """Outcomes of n readings, arrays (n,); `site` is -1 and the others are NaN where not one site is named."""

    matches: list
    status: np.ndarray
    site: np.ndarray
    force_newton: np.ndarray
    stated_newton: np.ndarray
    chi2: np.ndarray


def match_all(matcher, frequency, noise=NOISE):
    """Match readings (n, channels), with noise that is the same for all."""
    matches = [matcher.match(row, *noise) for row in frequency.tolist()]
    named = [match.forces[0] if len(match.forces) == 1 else None for match in matches]
    numbers = [
        (f.site, f.force_newton, np.hypot(f.noise_newton, f.systematic_newton)) if f else (-1, np.nan, np.nan)
        for f in named
    ]
    site, force, stated = np.array(numbers).T
    status, chi2 = (np.array([getattr(match, name) for match in matches]) for name in ("status", "chi2"))
    return Outcomes(matches, status, site.astype(int), force, stated, chi2)


def wrong(outcomes, site):
    """How many of the readings name a site that is not the true one."""
    named = zip(outcomes.matches, site.tolist(), strict=True)
    return sum(any(force.site != true for force in match.forces) for match, true in named)
