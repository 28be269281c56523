"""Whether the signals contradict the model of a contact, by the chi-square of its fit and that of a skin at rest."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtrc

from resonator_daemon.base.arrays import Floats

_CLIP2: Final = 9.0  # of the mean square: single dead sites hardly move the mean of clipped squares, ...
_CLIPPED_MEAN: Final = 0.9950073  # ... which is that of normal deviates
_SCATTER_MAX: Final = 4.0  # a declared noise that is off by more than a factor of two is not that of the signals
_REST_FRAMES_MIN: Final = 20  # before the scatter at rest counts as known
_REST_FRAMES: Final = 100  # over which it is averaged
P_LEAST: Final = 1e-5  # of a frame: below it, its signals contradict the fit ...
_RECENT, _CONTRADICTED = 5, 3  # ... and where so many of the last frames do, the model is wrong, ...
FRAMES: Final = 7  # ... or where the mean chi-square of so many frames ...
_EXCESS_STD: Final = 4.3  # ... lies so many standard deviations above 1, which has the same chance as the least p


@dataclass(frozen=True)
class FitQuality:
    """Goodness of the fit of a contact in one frame; contacts that were fitted together share it."""

    chi2: float  # per degree of freedom; about 1 where the model holds, at every noise
    degrees_of_freedom: int
    p: float  # chance of a chi-square as large as this or larger, if the model holds


class RestScatter:
    """Mean square of the signals of an untouched skin in units of their declared noise, which is rounded."""

    def __init__(self) -> None:
        self._mean = 1.0
        self._frames = 0

    def add(self, scores: Floats) -> None:
        """Add a frame at rest: signals in units of their noise, (3, n), NaN where they are not known."""
        squares = np.square(scores[np.isfinite(scores)])
        if squares.any():
            np.minimum(squares, _CLIP2 * max(self._mean, 1.0 / _SCATTER_MAX), out=squares)
            self._frames = min(self._frames + 1, _REST_FRAMES)
            self._mean += (float(squares.mean()) / _CLIPPED_MEAN - self._mean) / self._frames

    def quality(self, chi2: float, degrees_of_freedom: int, noise_share: float) -> FitQuality:
        """Return the goodness of a fit; `noise_share` of the signals' declared variance is noise, the rest gains."""
        if self._frames >= _REST_FRAMES_MIN:
            scatter = min(max(self._mean, 1.0 / _SCATTER_MAX), _SCATTER_MAX)
            chi2 /= 1.0 + noise_share * (scatter - 1.0)
        return FitQuality(chi2, degrees_of_freedom, float(chdtrc(degrees_of_freedom, chi2 * degrees_of_freedom)))


def contradicts(fits: Sequence[FitQuality], repeated_share: float) -> bool:
    """Return whether the last frames of a contact contradict its model; False alarms are rarer than one a year.

    `repeated_share` of the variance of chi-square is the same in all frames, because gains are.
    """
    if sum(fit.p < P_LEAST for fit in list(fits)[-_RECENT:]) >= _CONTRADICTED:
        return True
    if len(fits) < FRAMES:
        return False
    variance = 2.0 / fits[-1].degrees_of_freedom * ((1.0 - repeated_share) / FRAMES + repeated_share)
    return sum(fit.chi2 for fit in fits) / FRAMES - 1.0 > _EXCESS_STD * math.sqrt(variance)
