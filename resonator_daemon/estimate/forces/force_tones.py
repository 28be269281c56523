"""Tones of force sites on a channelised counter, corners combined: shifts and temperatures of the sites."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats

APART_SIGMAS: Final = 8.0
CORNER_ERROR: Final = 2e-7  # relative, by which f0 of a corner may be off
MODEL_MARGIN: Final = 0.1  # of a shift, by which corners may differ in K
FORCE, TEMPERATURE = 0, 1  # in `signal_index`


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
