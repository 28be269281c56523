"""Shape of a plate as viewers draw it, from its file or from what it publishes; moments about its origin."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.plate import Plate
from resonator_daemon.mqtt.payloads import Contact, Info


def about_origin(contact: Contact) -> NDArray[np.float64]:
    """Return force and moment about the plate's origin, (2, 3); of a force site those of its normal force."""
    if contact.moment_newton_m is not None:
        return np.array([contact.force_newton, contact.moment_newton_m], float)
    (x, y), normal_newton = contact.position_m, contact.force_newton[2]
    return np.array([(0.0, 0.0, normal_newton), (y * normal_newton, -x * normal_newton, 0.0)])


Places = NDArray[np.float64]
"""(n, 2): x and y in metres in the frame of the plate, whose z points into it."""


@dataclass(frozen=True)
class Geometry:
    """Outline, transducers and sites of one plate.

    Parameters
    ----------
    outline_m, transducers_m
        Corners, and transducers in the order of the channels.
    site_ids
        Numbers of the sites.
    sites_m
        Places of the sites, in the same order.
    force_max_newton
        End of the plate's range.
    """

    outline_m: Places
    transducers_m: Places
    site_ids: tuple[int, ...]
    sites_m: Places
    force_max_newton: float

    @classmethod
    def of_plate(cls, plate: Plate) -> Self:
        ids = tuple(int(site) for site in plate.site_ids)
        return cls(plate.outline_m, plate.transducers_m, ids, plate.site_positions_m, plate.force_max_newton)

    @classmethod
    def of_info(cls, info: Info) -> Self:
        ids = tuple(site.site for site in info.sites)
        sites_m = np.array([site.position_m for site in info.sites]).reshape(-1, 2)
        outline_m, transducers_m = (np.array(each).reshape(-1, 2) for each in (info.outline_m, info.transducers_m))
        return cls(outline_m, transducers_m, ids, sites_m, info.force_max_newton)
