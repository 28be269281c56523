"""What a contact that is warmer or colder than the plate may do to its site's frequency.

The site's temperature follows the contact's with one time constant: dT(t) = D (1 - exp(-t / tau)) for a contact that
differs from the plate by D, and what is there at release decays alike. The relative shift is static and transient,
a dT + a~ d(dT)/dt; the transient term is that of Ballato, IEEE Trans. Sonics and Ultrasonics 26, 299 (1979). Only the
spread of D is known, so the shift is a standard deviation.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

CONTACT_STD_KELVIN: Final = 3.0  # a fingertip through a cover, on a plate at room temperature
RELAXATION_S: Final = 5.0
TRANSIENT_S: Final = -2e-7  # a~ of an AT cut: relative shift per kelvin a second


def warming_std(
    held_s: FloatArray,
    slope_per_kelvin: FloatArray,
    contact_std_kelvin: float,
    *,
    transient_s: float = TRANSIENT_S,
    relaxation_s: float = RELAXATION_S,
) -> FloatArray:
    """Relative shift, one standard deviation, after `held_s` of contact; `slope_per_kelvin` is a; shapes broadcast.

    Raises ValueError where a time or standard deviation is negative.
    """
    _check(held_s, contact_std_kelvin, relaxation_s)
    left = np.exp(-held_s / relaxation_s)
    return contact_std_kelvin * np.abs(slope_per_kelvin * (1.0 - left) + transient_s / relaxation_s * left)


def cooling_std(
    held_s: FloatArray,
    released_s: FloatArray,
    slope_per_kelvin: FloatArray,
    contact_std_kelvin: float,
    *,
    transient_s: float = TRANSIENT_S,
    relaxation_s: float = RELAXATION_S,
) -> FloatArray:
    """Relative shift, one standard deviation, `released_s` after the end of a contact that lasted `held_s`.

    Raises ValueError where a time or standard deviation is negative.
    """
    _check(held_s, contact_std_kelvin, relaxation_s)
    _check(released_s, contact_std_kelvin, relaxation_s)
    warmed = -np.expm1(-held_s / relaxation_s) * np.exp(-released_s / relaxation_s)
    return contact_std_kelvin * np.abs(warmed * (slope_per_kelvin - transient_s / relaxation_s))


def _check(time_s: FloatArray, contact_std_kelvin: float, relaxation_s: float) -> None:
    if np.any(np.asarray(time_s) < 0):
        raise ValueError(f"time of {np.min(time_s)} s since a contact's start or end, at least 0")
    if not contact_std_kelvin >= 0:
        raise ValueError(f"contact_std_kelvin {contact_std_kelvin}, at least 0")
    if not relaxation_s > 0:
        raise ValueError(f"relaxation_s {relaxation_s} must be above 0")
