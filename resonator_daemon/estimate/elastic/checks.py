"""What callers hand in, as arrays of numbers."""

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Floats


def real_array(name: str, values: ArrayLike) -> Floats:
    """Return a new array of doubles; a ValueError names what is complex or no number, and shapes that are ragged."""
    try:
        array = np.array(values)
    except ValueError:
        raise ValueError(f"{name} is no array: its rows differ in length") from None
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name} holds {array.dtype.name}, must hold real numbers")
    return array.astype(np.float64)


def finite_array(name: str, values: ArrayLike) -> Floats:
    """`real_array` whose values are all finite, or a ValueError that counts those that are not."""
    array = real_array(name, values)
    if not np.isfinite(array).all():
        count = array.size - np.count_nonzero(np.isfinite(array))
        raise ValueError(f"{name} holds {count} values that are not finite; all must be")
    return array


def check_tolerance(tolerance: float) -> None:
    """Refuse a relative tolerance that is not above 0 and below 1."""
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"tolerance is {tolerance}, must be above 0 and below 1")
