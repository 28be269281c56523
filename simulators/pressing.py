"""What presses a plate at some moments, as the plates read it from scenarios and from clients alike."""

from typing import NamedTuple

import numpy as np

from simulators.arrays import Bools, Floats, Integers

RADIUS_M_AT_1_NEWTON = 2.5e-3  # of a contact with a skin that has no radius of its own
FRICTION_COEFFICIENT = 0.5  # where no other one is given


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
    radius_m_at_1_newton: Floats  # (k,), of contact with a skin
    friction_coefficient: Floats  # (k,), likewise


def joined(first: Pressing, second: Pressing) -> Pressing:
    """Return the touches of both, for the same moments."""
    pairs = zip(first, second, strict=True)
    return Pressing._make(np.concatenate(pair, axis=min(pair[0].ndim - 1, 1)) for pair in pairs)
