"""What a contact that is warmer or colder than the plate may do to its site's frequency.

The site's temperature follows the contact's with one time constant: dT(t) = D (1 - exp(-t / tau)) for a contact that
differs from the plate by D, and what is there at release decays alike. The relative shift is static and transient,
a dT + a~ d(dT)/dt; the transient term is that of Ballato, IEEE Trans. Sonics and Ultrasonics 26, 299 (1979). Only the
spread of D is known, so the shift is a standard deviation.
"""

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_Number = TypeVar("_Number", float, NDArray[np.float64])


def warmed_shift(left: _Number, slope_per_kelvin: _Number, transient_s: float, relaxation_s: float) -> _Number:
    """Relative shift by a contact one kelvin warmer, of whose difference from the site the share `left` is left."""
    return slope_per_kelvin * (1.0 - left) + transient_s / relaxation_s * left


def warming_std(held_s: float, slope_per_kelvin: float, transient_s: float, relaxation_s: float) -> float:
    """Relative shift by a contact one kelvin warmer or colder, after `held_s` of it; `slope_per_kelvin` is a."""
    return abs(warmed_shift(math.exp(-held_s / relaxation_s), slope_per_kelvin, transient_s, relaxation_s))
