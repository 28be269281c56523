"""The measurement chain of a plate: what plate file and configuration say, as the arguments that measurement takes."""

import math

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.config import Config
from resonator_daemon.forces.force_sites import USUAL_COEFFICIENT_STD, ForceSites, Warmth, known_coefficients
from resonator_daemon.forces.force_tones import ForceTones
from resonator_daemon.forces.site_response import SiteResponse
from resonator_daemon.plate import FORCE_SIGNAL, TEMPERATURE_SIGNAL, Plate, Response
from resonator_daemon.sensors.multitone import CombChain
from resonator_daemon.sensors.single_tone import SingleToneChain
from resonator_daemon.sensors.skin import SkinChain

Chain = SingleToneChain | CombChain | SkinChain


def make_chain(config: Config, oscillator_hz: NDArray[np.float64]) -> Chain:
    """Return the chain for a plate; `oscillator_hz` (tones,) is what a channelised board counts against."""
    plate, tones = config.plate, config.plate.tones
    gate_s = 1 / plate.counter.frame_rate_hz
    if plate.skin is not None:
        return SkinChain(
            tones.f0_hz,
            tones.sensitivity,
            oscillator_hz,
            tones.site_index,
            tones.signal_index,
            youngs_modulus_pascal=plate.skin.youngs_modulus_pascal,
            gate_s=gate_s,
        )
    window_frames = round(config.measurement.window_s / gate_s)
    step_frames = round(config.measurement.step_s / gate_s)
    if plate.counter.kind == "single-tone":
        return SingleToneChain(
            force_sites(plate),
            pilot_hz=plate.pilot_hz,
            reference_hz=plate.counter.reference_hz,
            gate_s=gate_s,
            window_frames=window_frames,
            step_frames=step_frames,
            load_sharing_exponent=plate.load_sharing_exponent,
        )
    return CombChain(
        force_sites(plate),
        ForceTones(tones.f0_hz, tones.sensitivity, oscillator_hz, tones.site_index, tones.signal_index),
        reference_hz=plate.counter.reference_hz,
        gate_s=gate_s,
        window_frames=window_frames,
        step_frames=step_frames,
        spread_width_m=plate.spread_width_m,
    )


def force_sites(plate: Plate) -> ForceSites:
    """Return what the plate file says of force sites, in the order of the sites."""
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
            max(thermal.coefficient_std, USUAL_COEFFICIENT_STD)
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
