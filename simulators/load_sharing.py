"""Loads of each force site under a scenario's touches: force, temperature of contact, and touch."""

from typing import NamedTuple

import numpy as np

from resonator_daemon.base.plate import Plate
from simulators.arrays import Floats, Integers
from simulators.pressing import Pressing

_TOUCHED_NEWTON = 1e-6
_UNDER_THE_FINGER = 0.5  # of the share of the site that bears most of a touch


class SiteLoads(NamedTuple):
    """What n moments load the sites with, each (n, sites) in the order of the plate's site_ids."""

    force_newton: Floats
    contact_kelvin: Floats  # NaN where nothing touches, or what does has the plate's temperature
    touch_id: Integers  # of the contact that presses hardest there; 0 where none does


def site_loads(pressing: Pressing, plate: Plate) -> SiteLoads:
    """Share the touches (n, k) of n moments among the sites; those of the whole plate press every site with all.

    Loads of several touches add up. A touch warms the sites that bear at least half as much of it as the one that bears
    most.
    """
    normal_newton, whole_plate = pressing.force_newton[..., 2], pressing.whole_plate
    pressed = np.flatnonzero(normal_newton.any(axis=0))
    shape = len(normal_newton), len(plate.site_ids)
    if not len(pressed):
        return SiteLoads(np.zeros(shape), np.full(shape, np.nan), np.zeros(shape, dtype=np.int64))
    position_m = pressing.position_m[:, pressed]
    if (position_m == position_m[0]).all():
        position_m = position_m[:1]
    shares = _shares(position_m, plate)
    shares[:, whole_plate[pressed]] = 1.0
    loads = shares * normal_newton[:, pressed, np.newaxis]  # (n, pressed, sites)
    force = loads.sum(axis=1)

    untouched = force <= _TOUCHED_NEWTON
    moment, site = np.arange(shape[0])[:, np.newaxis], np.arange(shape[1])
    hardest = loads.argmax(axis=1)  # (n, sites), of the touches that press
    touch = pressed[hardest]
    # A touch of the whole plate has an id for each site.
    touch_id = pressing.ids[moment, touch] + site * whole_plate[touch]
    touch_id[untouched] = 0
    contact_kelvin = np.full(shape, np.nan)
    if not np.isnan(pressing.contact_kelvin).all():
        contact_kelvin = pressing.contact_kelvin[moment, touch]
        warmed = loads >= _UNDER_THE_FINGER * loads.max(axis=2, keepdims=True)
        contact_kelvin[untouched | ~warmed[moment, hardest, site]] = np.nan
    return SiteLoads(force, contact_kelvin, touch_id)


def _shares(positions_m: Floats, plate: Plate) -> Floats:
    """Share (..., sites) that each site carries of a touch at each place (..., 2).

    Under a cover of width w that is (1 + r^2/w^2)^(-3/2); else r^-exponent relative to all sites, so that a touch
    exactly on a site loads that one alone.
    """
    offset_m = positions_m[..., np.newaxis, :] - plate.site_positions_m
    distance_m: Floats = np.hypot(offset_m[..., 0], offset_m[..., 1])
    if plate.spread_width_m is not None:
        spread: Floats = (1.0 + (distance_m / plate.spread_width_m) ** 2) ** -1.5
        return spread
    # Relative to the nearest site, so that a touch on a site is the limit and not a division by 0.
    distance_m = np.maximum(distance_m, 1e-12)
    weight = (distance_m / distance_m.min(axis=-1, keepdims=True)) ** -(plate.load_sharing_exponent or np.inf)
    shares: Floats = weight / weight.sum(axis=-1, keepdims=True)
    return shares
