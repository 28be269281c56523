"""Arrays of the calibration of force sites."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.forces.site_response import SiteResponse

# Of an AT cut near its zero slope at 25 C, where the plate file does not give them: 1/K, 1/K^2, 1/K^3.
DEFAULT_COEFFICIENTS: Final = (-5e-8, -0.5e-9, 1.08e-10)
DEFAULT_COEFFICIENT_STD: Final = 5e-8  # 1/K: a third of an arc minute of the cut, from site to site


@dataclass(frozen=True, eq=False)
class Warmth:
    """Temperature coefficients of sites, and the temperature difference that a touch may have.

    `coefficients` (m, 3) are a, b, c of the relative shift a d + b d^2 + c d^3, d from the calibration's temperature;
    a is known to `coefficient_std`. `transient_s` is the shift for each K/s; a touch differs from the plate by
    `contact_std_kelvin` (m,), 0 where the site has a thermometer, and its site takes that on within `contact_time_s`.
    """

    coefficients: Floats
    coefficient_std: float
    transient_s: float
    contact_std_kelvin: Floats
    contact_time_s: float


@dataclass(frozen=True, eq=False)
class ForceSites:
    """Codes of m sites on a number of channels, with their errors.

    `f0_hz` and the signed `sensitivity` K in 1/N are (m, channels), `positions_m` (m, 2), `outline_m` (p, 2).
    `model_error` is the relative error of K from touch to touch and channel to channel, `sensitivity_std` the one that
    all touches share. `valid_newton` and `valid_kelvin` are the ranges of calibration; `response` is None where
    hysteresis and creep were not calibrated.
    """

    f0_hz: Floats
    sensitivity: Floats
    positions_m: Floats
    outline_m: Floats
    force_max_newton: float
    warmth: Warmth
    model_error: float
    sensitivity_std: float = 0.0
    valid_newton: tuple[float, float] = (-math.inf, math.inf)
    valid_kelvin: tuple[float, float] = (-math.inf, math.inf)  # against the temperature at which f0 holds
    response: SiteResponse | None = None

    def newton_per_shift(self, site: int, channels: tuple[int, ...]) -> float:
        """Force that a relative shift common to `channels` passes for: 1/|K| where K is equal on all of them."""
        row: list[float] = self.sensitivity[site].tolist()
        sensitivity = [row[channel] for channel in channels]
        return abs(sum(sensitivity) / sum([k * k for k in sensitivity]))


def known_coefficients(coefficients: Floats) -> Floats:
    """Return coefficients (m, 3) with the crystal's default instead of each NaN."""
    return np.where(np.isnan(coefficients), DEFAULT_COEFFICIENTS, coefficients)
