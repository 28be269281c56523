"""What presses a plate at some moments, as the plates read it from scenarios and from clients alike."""

from typing import NamedTuple

import numpy as np

from simulators.arrays import Bools, Floats, Integers


class Pressing(NamedTuple):
    """What each of k touches does at n moments.

    Each touch has an id of its own. One of the whole plate takes as many as there are sites: site index s is pressed by
    contact id + s.
    """

    ids: Integers  # (n, k)
    force_newton: Floats  # (n, k, 3): x, y, z; z presses
    position_m: Floats  # (n, k, 2); of the whole plate: the middle of its outline
    contact_kelvin: Floats  # (n, k); NaN where a touch has the plate's temperature
    whole_plate: Bools  # (k,)


def joined(first: Pressing, second: Pressing) -> Pressing:
    """Return the touches of both, for the same moments."""
    pairs = zip(first, second, strict=True)
    return Pressing._make(np.concatenate(pair, axis=min(pair[0].ndim - 1, 1)) for pair in pairs)
