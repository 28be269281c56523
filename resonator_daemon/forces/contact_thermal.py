"""What a contact that is warmer or colder than the plate may do to its site's frequency.

The site's temperature follows the contact's with one time constant: dT(t) = D (1 - exp(-t / tau)) for a contact that
differs from the plate by D, and what is there at release decays alike. The relative shift is static and transient,
a dT + a~ d(dT)/dt; the transient term is that of Ballato, IEEE Trans. Sonics and Ultrasonics 26, 299 (1979). Only the
spread of D is known, so the shift is a standard deviation.
"""

import math
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

CONTACT_STD_KELVIN: Final = 3.0  # a fingertip through a cover, on a plate at room temperature
RELAXATION_S: Final = 5.0
TRANSIENT_S: Final = -2e-7  # a~ of an AT cut: relative shift per kelvin a second


_Number = TypeVar("_Number", float, NDArray[np.float64])


def warmed_shift(left: _Number, slope_per_kelvin: _Number, transient_s: float, relaxation_s: float) -> _Number:
    """Relative shift by a contact one kelvin warmer, of whose difference from the site the share `left` is left."""
    return slope_per_kelvin * (1.0 - left) + transient_s / relaxation_s * left


def warming_std(
    held_s: float,
    slope_per_kelvin: float,
    contact_std_kelvin: float,
    *,
    transient_s: float = TRANSIENT_S,
    relaxation_s: float = RELAXATION_S,
) -> float:
    """Relative shift, one standard deviation, after `held_s` of contact; `slope_per_kelvin` is a.

    Raises ValueError where a time or standard deviation is negative.
    """
    _check(held_s, contact_std_kelvin, relaxation_s)
    left = math.exp(-held_s / relaxation_s)
    return contact_std_kelvin * abs(warmed_shift(left, slope_per_kelvin, transient_s, relaxation_s))


def cooling_std(
    held_s: float,
    released_s: float,
    slope_per_kelvin: float,
    contact_std_kelvin: float,
    *,
    transient_s: float = TRANSIENT_S,
    relaxation_s: float = RELAXATION_S,
) -> float:
    """Relative shift, one standard deviation, `released_s` after the end of a contact that lasted `held_s`.

    Raises ValueError where a time or standard deviation is negative.
    """
    _check(held_s, contact_std_kelvin, relaxation_s)
    _check(released_s, contact_std_kelvin, relaxation_s)
    warmed = -math.expm1(-held_s / relaxation_s) * math.exp(-released_s / relaxation_s)
    return contact_std_kelvin * abs(warmed * (slope_per_kelvin - transient_s / relaxation_s))


def _check(time_s: float, contact_std_kelvin: float, relaxation_s: float) -> None:
    if time_s < 0:
        raise ValueError(f"time of {time_s} s since a contact's start or end, at least 0")
    if not contact_std_kelvin >= 0:
        raise ValueError(f"contact_std_kelvin {contact_std_kelvin}, at least 0")
    if not relaxation_s > 0:
        raise ValueError(f"relaxation_s {relaxation_s} must be above 0")
