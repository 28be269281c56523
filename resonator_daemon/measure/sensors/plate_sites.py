"""Force sites of a plate file, as arrays in the order of the sites."""

import math

import numpy as np

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL, TEMPERATURE_SIGNAL, Response
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
