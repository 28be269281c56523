"""Whether a plate's sites can be distinguished by their codes, over its forces and temperatures."""

import math
from typing import Final

import numpy as np

from resonator_daemon.base.plate import Plate
from resonator_daemon.estimate.forces.codes import CodeOverlap, code_overlaps
from resonator_daemon.measure.sensors.plate_sites import force_sites

AGEING: Final = 2e-6  # of one site against another, relative: a year or two
NOISE: Final = 1e-8  # of a reading
SIGMAS: Final = 7.0


def overlaps(plate: Plate) -> tuple[CodeOverlap, ...]:
    """Return the pairs of sites that a single-tone counter can mistake for each other, the worst first."""
    if plate.counter.kind != "single-tone":
        return ()
    sites, thermal = force_sites(plate), plate.thermal
    away_kelvin = np.abs(np.array(thermal.range_kelvin) - thermal.reference_kelvin).max()
    apart = float(np.ptp(sites.warmth.coefficients[:, 0])) + 6.0 * sites.warmth.coefficient_std
    largest_shift = float(np.abs(sites.sensitivity).max()) * sites.force_max_newton
    return code_overlaps(
        sites.f0_hz,
        sites.sensitivity,
        sites.force_max_newton,
        common_shift=AGEING + apart * away_kelvin,
        margin=SIGMAS * math.hypot(NOISE, sites.model_error * largest_shift),
    )


def findings(plate: Plate) -> tuple[str, ...]:
    """Return a sentence on the worst pair of codes that overlap; none where codes differ, or the plate insists."""
    found = overlaps(plate)
    if not found or plate.counter.codes_may_overlap:
        return ()
    worst = found[0]
    one, other = (int(plate.site_ids[site]) for site in (worst.site, worst.other))
    low, high = plate.thermal.range_kelvin
    others = f", and {len(found) - 1} more pairs" if len(found) > 1 else ""
    return (
        f"sites of plate {plate.name!r}: ids {one} and {other} can be mistaken for each other{others}: on channel "
        f"{worst.channel} their tones are {worst.spacing_ppm:.0f} ppm apart, {worst.needed_ppm:.0f} ppm are needed for "
        f"forces up to {plate.force_max_newton:g} N from {low:g} to {high:g} K; space the codes further apart, as "
        "`resonatord plan codes` does, or set counter.codes_may_overlap = true",
    )
