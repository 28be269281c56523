"""Arrays of the calibration of force sites, force from a frequency by eq. (1), and what a touch between sites hides."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.forces.site_response import SiteResponse

# Of an AT cut near its zero slope at 25 C, where the plate file does not give them: 1/K, 1/K^2, 1/K^3.
DEFAULT_COEFFICIENTS: Final = (-5e-8, -0.5e-9, 1.08e-10)
DEFAULT_COEFFICIENT_STD: Final = 5e-8  # 1/K: a third of an arc minute of the cut, from site to site

GRID_STEPS = 128  # positions across the longer side of an outline
LEVEL_MARGIN = 0.5  # a site with half the largest share can still be the one that a corner captures


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


def force_newton(f0_hz: Floats, frequency_hz: Floats, sensitivity: Floats) -> Floats:
    """Force by (f - f0) / f = K F, the shift normalised by f, for signed `sensitivity` K in 1/N; shapes broadcast."""
    return (1.0 - f0_hz / frequency_hz) / sensitivity


def positions_inside(outline_m: Floats) -> Floats:
    """Positions of a regular grid inside the polygon `outline_m` (p, 2), as (n, 2)."""
    low, high = outline_m.min(axis=0), outline_m.max(axis=0)
    pitch_m = float((high - low).max()) / GRID_STEPS
    axes = [np.arange(low[i] + pitch_m / 2, high[i], pitch_m) for i in (0, 1)]
    x, y = (axis.ravel() for axis in np.meshgrid(*axes))
    inside = np.zeros(x.shape, dtype=bool)
    for (x0, y0), (x1, y1) in zip(outline_m, np.roll(outline_m, -1, axis=0), strict=True):
        if y0 != y1:  # even-odd rule: a ray along +x crosses this edge
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return np.stack([x[inside], y[inside]], axis=1)


def hidden_fraction(site_positions_m: Floats, outline_m: Floats, exponent: float) -> Floats:
    """Largest force that a touch can hide from each site, per newton that the site reports; shape (m,).

    Model: a touch at distance d_j from site j loads it with the share d_j^-exponent / sum_i d_i^-exponent. One captured
    tone reports the share of one site as if it were the whole, so it hides (1/share - 1) times what it reports. The
    bound for site m is taken over every position of the outline (p, 2) where a corner may capture m: where its share
    is at least half of the largest, because levels differ from corner to corner.
    """
    positions = positions_inside(outline_m)
    # Shares relative to the nearest site's keep powers of small distances within range.
    distance_m = [np.linalg.norm(positions - site, axis=1) + 1e-12 for site in site_positions_m]
    nearest_m = np.minimum.reduce(distance_m)
    relative = [(nearest_m / d) ** exponent for d in distance_m]
    total = np.add.reduce(relative)
    bound = np.zeros(len(relative))
    for m, share in enumerate(relative):
        detected = share >= LEVEL_MARGIN
        bound[m] = np.max(total[detected] / share[detected] - 1.0, initial=0.0)
    return bound


def cell_std_m(site_positions_m: Floats, outline_m: Floats) -> Floats:
    """Spread of the touches nearest to each site, per axis about the site: rms over its cell of the outline; (m, 2)."""
    positions = positions_inside(outline_m)
    nearest = np.argmin([np.sum((positions - site) ** 2, axis=1) for site in site_positions_m], axis=0)
    spread = np.zeros(site_positions_m.shape)
    for m, site in enumerate(site_positions_m):
        cell = positions[nearest == m] - site
        if len(cell):
            spread[m] = np.sqrt(np.mean(cell**2, axis=0))
    return spread
