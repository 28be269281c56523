"""What the options of `resonatord plan codes` come to, in SI units."""

import argparse
import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.errors import ConfigurationError, UsageError
from resonator_daemon.base.host.files import NoNewFileError, check_new
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from resonator_daemon.estimate.forces.force_sites import DEFAULT_COEFFICIENT_STD
from resonator_daemon.estimate.forces.site_identification import MODEL_ERROR
from resonator_daemon.estimate.tones.frequency_estimators import oscillator_std
from resonator_daemon.extensions.planning.code_ladder import Limits, stamp_noise
from resonator_daemon.extensions.planning.plate_file import (
    PILOT_ABOVE,
    Layout,
    PlateDraft,
    grid_layout,
    plate_layout,
    read_layout,
)
from resonator_daemon.measure.sensors.plate_sites import force_sites

JITTER_S: Final = 0.3e-9  # of a counter's input
TEMPCO_STDS: Final = 6.0  # between the temperature coefficients of two sites
SITES_MAX: Final = 1000
STAMPS_MAX: Final = 65_535  # of a record on the wire

_LADDER: Final = {
    "sensitivity_ppm_per_newton": -6.3,
    "sensitivity_spread": 0.3,
    "tolerance_ppm": 20.0,
    "pull_ppm": 25.0,
    "f0_mhz": 10.0,
    "step_ppm": None,
    "coupling": None,
}
_ANYHOW: Final = {
    "force_max_newton": 10.0,
    "temperature_span_kelvin": 20.0,
    "ageing_ppm": 2.0,
    "counter_tick_ns": 1.0,
    "frame_rate_hz": 1000.0,
}


@dataclass(frozen=True, eq=False)
class Request:
    """What the options come to, in SI units; `plate` is the one whose codes are kept."""

    layout: Layout
    sensitivity: NDArray[np.float64]  # (m, channels), as aimed at
    spread: float
    f0_hz: float
    tempco_std: float  # of a site, 1/K
    draft: PlateDraft
    limits: Limits
    plate: Plate | None


def make_request(options: argparse.Namespace) -> Request:
    """Check the options against each other and against what they name; UsageError names what does not fit."""
    _check_options(options)
    plate = _named_plate(options.plate)
    given = _with_defaults(options, plate)
    layout = _layout(options, plate)
    if len(layout.site_ids) > SITES_MAX:
        raise UsageError(f"{len(layout.site_ids)} sites; at most {SITES_MAX} can be planned: take fewer")
    if (stamps := options.stamps_per_s / given["frame_rate_hz"]) > STAMPS_MAX:
        raise UsageError(
            f"--stamps-per-s {options.stamps_per_s:g}: {stamps:g} in a frame, at most {STAMPS_MAX} fit into a record; "
            "lower it, or raise --frame-rate-hz"
        )
    sensitivity, spread, model_error = _sensitivity(options, given, plate, len(layout.site_ids))
    force_max_newton = given["force_max_newton"]
    largest_shift = float(np.abs(sensitivity).max()) * (1.0 + spread) * force_max_newton
    if not 0.0 < largest_shift < 0.1:
        raise UsageError(
            f"sensitivity times --force-max-newton: the largest shift is {1e6 * largest_shift:g} ppm, must be above 0 "
            "and below 100000; lower the force or the sensitivity"
        )
    tempco_std, tempco_difference = _temperature_coefficients(plate)
    window_s = 1e-3 * options.window_ms
    counter_std = stamp_noise(1e-9 * given["counter_tick_ns"], JITTER_S, options.stamps_per_s, window_s)
    noise_std = math.hypot(counter_std, oscillator_std(window_s), model_error * largest_shift)
    draft = PlateDraft(
        name=options.output.stem if options.output is not None else "planned",
        force_max_newton=force_max_newton,
        reference_hz=1e9 / given["counter_tick_ns"],
        frame_rate_hz=given["frame_rate_hz"],
        temperature_span_kelvin=given["temperature_span_kelvin"],
        sensitivity_std=spread / math.sqrt(3.0),
        load_sharing_exponent=plate.load_sharing_exponent if plate is not None else None,
    )
    return Request(
        layout=layout,
        sensitivity=sensitivity,
        spread=spread,
        f0_hz=1e6 * given["f0_mhz"],
        tempco_std=tempco_std,
        draft=draft,
        limits=_limits(options, given, tempco_difference, noise_std),
        plate=_as_used(plate, draft) if plate is not None and options.keep_codes else None,
    )


def _sensitivity(
    options: argparse.Namespace, given: dict[str, Any], plate: Plate | None, count: int
) -> tuple[NDArray[np.float64], float, float]:
    """Return K in 1/N, (m, channels), what sites differ from it, and its error from touch to touch, both relative."""
    if plate is not None and options.sensitivity_ppm_per_newton is None:
        sites = force_sites(plate)
        return sites.sensitivity, options.sensitivity_spread or 0.0, sites.model_error
    default = np.full((count, CHANNEL_COUNT), 1e-6 * given["sensitivity_ppm_per_newton"])
    return default, given["sensitivity_spread"], MODEL_ERROR


def _limits(options: argparse.Namespace, given: dict[str, Any], tempco_difference: float, noise_std: float) -> Limits:
    return Limits(
        force_max_newton=given["force_max_newton"],
        temperature_span_kelvin=given["temperature_span_kelvin"],
        tempco_difference_per_kelvin=tempco_difference,
        ageing=1e-6 * given["ageing_ppm"],
        noise_std=noise_std,
        pulling=0.0 if options.keep_codes else 1e-6 * given["pull_ppm"],
        tolerance=0.0 if options.keep_codes else 1e-6 * given["tolerance_ppm"],
        common_shift=1e-6 * options.common_ppm if options.no_pilot else 0.0,
    )


def _as_used(plate: Plate, draft: PlateDraft) -> Plate:
    """Return a plate with its codes, for other forces, temperatures and counters than its own."""
    middle = sum(plate.thermal.range_kelvin) / 2
    half = draft.temperature_span_kelvin / 2
    counter = {"reference_hz": draft.reference_hz, "frame_rate_hz": draft.frame_rate_hz}
    return plate.model_copy(
        update={
            "force_max_newton": draft.force_max_newton,
            "thermal": plate.thermal.model_copy(update={"range_kelvin": (middle - half, middle + half)}),
            "counter": plate.counter.model_copy(update=counter),
        }
    )


def _check_options(options: argparse.Namespace) -> None:
    findings = []
    if (options.grid is None) != (options.pitch_mm is None):
        findings.append("--grid and --pitch-mm belong together: give both or neither, as --grid 4x4 --pitch-mm 5")
    if options.sensitivity_ppm_per_newton == 0:
        findings.append("--sensitivity-ppm-per-newton 0: must not be zero; give the expected, signed value, as -6.3")
    if options.keep_codes:
        if options.plate is None:
            findings.append("--keep-codes needs --plate: the plate whose codes are to be judged")
        for name in (*_LADDER, "output"):
            if getattr(options, name) is not None:
                findings.append(f"--{name.replace('_', '-')} does not go with --keep-codes; leave one of them out")
    if options.no_pilot and options.output is not None:
        findings.append(
            "--output does not go with --no-pilot: the daemon estimates the common mode of a plate with captured tones "
            "from its pilot; leave one of them out"
        )
    if findings:
        raise UsageError(*findings)
    if options.output is not None:
        check_new(options.output)
        if not (directory := options.output.resolve().parent).is_dir():
            raise NoNewFileError(f"{options.output}: {directory} is no directory; make it first")


def _named_plate(name: str | None) -> Plate | None:
    if name is None:
        return None
    try:
        plate = load_plate(name)
    except ConfigurationError as error:
        raise UsageError(*(f"--plate: {message}" for message in error.messages)) from None
    if plate.signals != (FORCE_SIGNAL,) or plate.counter.kind != "single-tone":
        raise UsageError(
            f"--plate: {plate.name!r} has a {plate.counter.kind} counter of {', '.join(plate.signals)}; codes are "
            "planned for force sites on a single-tone counter: name such a plate, or give --sites"
        )
    return plate


def _layout(options: argparse.Namespace, plate: Plate | None) -> Layout:
    if plate is not None:
        return plate_layout(plate)
    if options.grid is not None:
        columns, rows = options.grid
        return grid_layout(columns, rows, 1e-3 * options.pitch_mm)
    try:
        return read_layout(options.sites)
    except ConfigurationError as error:
        raise UsageError(*(f"--sites: {message}" for message in error.messages)) from None


def _with_defaults(options: argparse.Namespace, plate: Plate | None) -> dict[str, Any]:
    defaults: dict[str, Any] = {**_LADDER, **_ANYHOW}
    if plate is not None:
        low, high = plate.thermal.range_kelvin
        defaults |= {
            "f0_mhz": 1e-6 * plate.pilot_hz / (1.0 + PILOT_ABOVE),
            "force_max_newton": plate.force_max_newton,
            "temperature_span_kelvin": high - low,
            "counter_tick_ns": 1e9 / plate.counter.reference_hz,
            "frame_rate_hz": plate.counter.frame_rate_hz,
        }
    given = {name: getattr(options, name) for name in defaults}
    return {name: defaults[name] if value is None else value for name, value in given.items()}


def _temperature_coefficients(plate: Plate | None) -> tuple[float, float]:
    """Return the standard deviation of a site's and the largest difference of two sites', in 1/K."""
    if plate is None:
        return DEFAULT_COEFFICIENT_STD, TEMPCO_STDS * DEFAULT_COEFFICIENT_STD
    warmth = force_sites(plate).warmth
    apart = float(np.ptp(warmth.coefficients[:, 0]))
    return warmth.coefficient_std, apart + TEMPCO_STDS * warmth.coefficient_std
