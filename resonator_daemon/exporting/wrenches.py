"""Force and moment of a contact about the origin of the plate's coordinates."""

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.publishing.payloads import Contact


def about_origin(contact: Contact) -> NDArray[np.float64]:
    """Return force and moment about the plate's origin, (2, 3); of a force site those of its normal force."""
    if contact.moment_newton_m is not None:
        return np.array([contact.force_newton, contact.moment_newton_m], float)
    (x, y), normal_newton = contact.position_m, contact.force_newton[2]
    return np.array([(0.0, 0.0, normal_newton), (y * normal_newton, -x * normal_newton, 0.0)])
