"""Force sites: arrays of their calibration, force from a frequency by eq. (1), shifts of tones, geometry of sites."""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats

# Of an AT cut near its zero slope at 25 C, where the plate file does not give them: 1/K, 1/K^2, 1/K^3.
DEFAULT_COEFFICIENTS: Final = (-5e-8, -0.5e-9, 1.08e-10)
DEFAULT_COEFFICIENT_STD: Final = 5e-8  # 1/K: a third of an arc minute of the cut, from site to site

GRID_STEPS = 128  # positions across the longer side of an outline
LEVEL_MARGIN = 0.5  # a site with half the largest share can still be the one that a corner captures

APART_SIGMAS: Final = 8.0
CORNER_ERROR: Final = 2e-7  # relative, by which f0 of a corner may be off
MODEL_MARGIN: Final = 0.1  # of a shift, by which corners may differ in K
FORCE, TEMPERATURE = 0, 1  # in `signal_index`


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


class SiteShifts(NamedTuple):
    """Relative shift y = 1 - f0 / f of m sites, (m,), with the variance of its noise; NaN where no corner is known.

    `kelvin` is the site's temperature against calibration's by its own tone, but for the reference's error, NaN where
    there is none; `sensitivity` the K that `shift` goes by.
    """

    shift: Floats
    variance: Floats
    sensitivity: Floats
    kelvin: Floats


class ForceTones:
    """Tones of a plate: one for the force of each site, perhaps one for its temperature, each at four corners."""

    def __init__(
        self,
        f0_hz: Floats,
        sensitivity: Floats,
        oscillator_hz: Floats,
        site_index: NDArray[np.integer],
        signal_index: NDArray[np.integer],
    ) -> None:
        """Initialise with arrays by tone: f0 and signed sensitivity (t, 4), in 1/N or 1/K, the others (t,).

        Sensitivities of both signs at one site's corners are refused: their mean has no meaning.
        """
        if not (np.abs(np.sign(sensitivity).sum(axis=1)) == 4).all():
            raise ValueError("sensitivity must not be 0, and of one sign on the corners of a tone")
        self.shape = f0_hz.T.shape
        self._oscillator_hz = oscillator_hz
        self._f0_hz = np.ascontiguousarray(f0_hz.T)
        self._sensitivity = np.ascontiguousarray(sensitivity.T)
        self._sites = int(site_index.max()) + 1
        self._of_force = _by_site(site_index, signal_index, FORCE, self._sites)
        self._of_temperature = _by_site(site_index, signal_index, TEMPERATURE, self._sites)
        if (self._of_force < 0).any():
            raise ValueError(f"site {int(np.argmin(self._of_force))} has no tone for its force")

    def shifts(self, offset_hz: Floats, sigma_hz: Floats) -> SiteShifts:
        """Combine the corners, each by its variance; both arrays (4, t), NaN where a tone is not known."""
        frequency = self._oscillator_hz + offset_hz
        known = np.isfinite(frequency) & np.isfinite(sigma_hz) & (sigma_hz > 0) & (frequency > 0)
        shift = np.where(known, 1.0 - self._f0_hz / np.where(known, frequency, 1.0), 0.0)
        std = np.where(known, sigma_hz / np.where(known, frequency, 1.0), np.inf)
        known &= _agree(shift, std, known)
        shift, weight = np.where(known, shift, 0.0), np.where(known, 1.0 / std**2, 0.0)
        total = weight.sum(axis=0)
        detected = total > 0
        scale = np.where(detected, 1.0 / np.where(detected, total, 1.0), np.nan)
        combined = (weight * shift).sum(axis=0) * scale
        sensitivity = (weight * self._sensitivity).sum(axis=0) * scale
        force = self._of_force
        warm = self._of_temperature
        kelvin = np.where(warm >= 0, combined[warm] / sensitivity[warm], np.nan)
        return SiteShifts(combined[force], scale[force], sensitivity[force], kelvin)


def _agree(shift: Floats, std: Floats, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which corners agree with the others, (4, t); at least three must be known."""
    count = known.sum(axis=0)
    tone = np.arange(shift.shape[1])
    order = np.argsort(np.where(known, shift, np.inf), axis=0)
    low, high = order[np.maximum(count - 1, 0) // 2, tone], order[count // 2 % len(shift), tone]
    middle = (shift[low, tone] + shift[high, tone]) / 2.0
    middle_std = np.maximum(std[low, tone], std[high, tone])
    allowed = APART_SIGMAS * np.hypot(std, middle_std) + CORNER_ERROR + MODEL_MARGIN * np.abs(middle)
    agree: NDArray[np.bool_] = (count < 3) | (np.abs(shift - middle) <= allowed)
    return agree


def _by_site(
    site_index: NDArray[np.integer], signal_index: NDArray[np.integer], signal: int, sites: int
) -> NDArray[np.intp]:
    """Tone of each site that carries `signal`, -1 where there is none."""
    tone = np.full(sites, -1, dtype=np.intp)
    (which,) = np.nonzero(signal_index == signal)
    tone[site_index[which]] = which
    return tone
