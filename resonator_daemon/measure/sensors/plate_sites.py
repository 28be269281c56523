"""Force sites of a plate file, as arrays in the order of the sites."""

import math
from typing import Final

import numpy as np

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL, TEMPERATURE_SIGNAL, Response
from resonator_daemon.estimate.forces.codes import CodeOverlap, code_overlaps
from resonator_daemon.estimate.forces.force_sites import (
    DEFAULT_COEFFICIENT_STD,
    ForceSites,
    SiteResponse,
    Warmth,
    known_coefficients,
)


def force_sites(plate: Plate) -> ForceSites:
    """Return the force sites of a plate with codes, calibration and response."""
    tones, thermal, calibration = plate.tones, plate.thermal, plate.calibration
    of_force = np.flatnonzero(tones.signal_index == plate.signals.index(FORCE_SIGNAL))
    of_force = of_force[np.argsort(tones.site_index[of_force])]
    contact_std_kelvin = np.full(len(plate.site_ids), thermal.contact_std_kelvin)
    if TEMPERATURE_SIGNAL in plate.signals:
        has_thermometer = tones.signal_index == plate.signals.index(TEMPERATURE_SIGNAL)
        contact_std_kelvin[tones.site_index[has_thermometer]] = 0.0
    coefficients = tones.temperature_coefficients[of_force]
    valid, kelvin = calibration.validity, thermal.reference_kelvin
    return ForceSites(
        tones.f0_hz[of_force],
        tones.sensitivity[of_force],
        plate.site_positions_m,
        plate.outline_m,
        plate.force_max_newton,
        Warmth(
            known_coefficients(coefficients),
            max(thermal.coefficient_std, DEFAULT_COEFFICIENT_STD)
            if np.isnan(coefficients).any()
            else thermal.coefficient_std,
            thermal.transient_s,
            contact_std_kelvin,
            thermal.contact_time_s,
        ),
        calibration.model_error,
        calibration.sensitivity_std,
        (valid.force_newton[0], valid.force_newton[1]) if valid else (-math.inf, math.inf),
        (valid.kelvin[0] - kelvin, valid.kelvin[1] - kelvin) if valid else (-math.inf, math.inf),
        _site_response(plate.response) if plate.response else None,
    )


def _site_response(response: Response) -> SiteResponse:
    std = response.relative_std
    return SiteResponse(
        response.hysteresis_newton,
        response.creep_fraction,
        response.creep_time_s,
        std * response.hysteresis_newton,
        std * response.creep_fraction,
        std * response.creep_time_s,
    )


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
