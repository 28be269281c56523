"""What the options of `resonatord plan codes` come to, in SI units."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial import cKDTree

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.errors import ConfigurationError, UsageError, meaning_of
from resonator_daemon.base.host.files import NoNewFileError, check_new
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from resonator_daemon.estimate.forces.force_sites import DEFAULT_COEFFICIENT_STD
from resonator_daemon.estimate.forces.site_identification import MODEL_ERROR
from resonator_daemon.estimate.tones.frequency_estimators import oscillator_std
from resonator_daemon.extensions.planning.code_ladder import Tolerances, stamp_noise
from resonator_daemon.measure.sensors.plate_sites import force_sites

JITTER_S: Final = 0.3e-9  # of a counter's input
TEMPCO_STDS: Final = 6.0  # between the temperature coefficients of two sites
PILOT_ABOVE: Final = 1e-3  # the tone that no code has, relative
LEAST_BORDER_M: Final = 2e-3
SITES_MAX: Final = 256
STAMPS_MAX: Final = 65_535  # of a record on the wire

_DEFAULTS: Final[dict[str, float]] = {
    "f0_mhz": 10.0,
    "force_max_newton": 10.0,
    "temperature_span_kelvin": 20.0,
    "counter_tick_ns": 1.0,
    "frame_rate_hz": 1000.0,
}


@dataclass(frozen=True, eq=False)
class Request:
    """Sites, m of them, their plate, and what their codes must accept."""

    site_ids: tuple[int, ...]
    positions_m: Floats  # (m, 2)
    outline_m: Floats
    transducers_m: Floats
    load_sharing_exponent: float | None
    sensitivity: Floats  # (m, channels) in 1/N, as aimed at
    f0_hz: float
    reference_hz: float
    frame_rate_hz: float
    tolerances: Tolerances


def make_request(options: argparse.Namespace) -> Request:
    """Check the options against each other and against what they name; UsageError names what does not fit."""
    _check_options(options)
    plate = _named_plate(options.plate)
    given = _with_defaults(options, plate)
    if (stamps := options.stamps_per_s / given["frame_rate_hz"]) > STAMPS_MAX:
        raise UsageError(
            f"--stamps-per-s {options.stamps_per_s:g}: {stamps:g} in a frame, at most {STAMPS_MAX} fit into a record; "
            "lower it, or raise --frame-rate-hz"
        )
    if plate is not None:
        place = (tuple(plate.site_ids.tolist()), plate.site_positions_m, plate.outline_m, plate.transducers_m)
    else:
        place = _within_a_rectangle(_positions_m(options))
    if len(place[0]) > SITES_MAX:
        raise UsageError(f"{len(place[0])} sites; at most {SITES_MAX} can be planned: take fewer")
    sensitivity = np.full((len(place[0]), CHANNEL_COUNT), 1e-6 * (options.sensitivity_ppm_per_newton or -6.3))
    spread, model_error = options.sensitivity_spread, MODEL_ERROR
    tempco_std, tempco_difference = DEFAULT_COEFFICIENT_STD, TEMPCO_STDS * DEFAULT_COEFFICIENT_STD
    if plate is not None:
        sites = force_sites(plate)
        tempco_std = sites.warmth.coefficient_std
        tempco_difference = float(np.ptp(sites.warmth.coefficients[:, 0])) + TEMPCO_STDS * tempco_std
        if options.sensitivity_ppm_per_newton is None:
            sensitivity, model_error = sites.sensitivity, sites.model_error
            spread = spread or 0.0
    spread = 0.3 if spread is None else spread
    largest_shift = float(np.abs(sensitivity).max()) * (1.0 + spread) * given["force_max_newton"]
    if not 0.0 < largest_shift < 0.1:
        raise UsageError(
            f"sensitivity times --force-max-newton: the largest shift is {1e6 * largest_shift:g} ppm, must be above 0 "
            "and below 100000; lower the force or the sensitivity"
        )
    window_s = 1e-3 * options.window_ms
    tolerances = Tolerances(
        force_max_newton=given["force_max_newton"],
        temperature_span_kelvin=given["temperature_span_kelvin"],
        tempco_std=tempco_std,
        tempco_difference_per_kelvin=tempco_difference,
        ageing=1e-6 * options.ageing_ppm,
        pulling=1e-6 * options.pull_ppm,
        placement=1e-6 * options.tolerance_ppm,
        sensitivity_spread=spread,
        model_error=model_error,
        counter_std=stamp_noise(1e-9 * given["counter_tick_ns"], JITTER_S, options.stamps_per_s, window_s),
        oscillator_std=oscillator_std(window_s),
    )
    return Request(
        *place,
        load_sharing_exponent=plate.load_sharing_exponent if plate is not None else None,
        sensitivity=sensitivity,
        f0_hz=1e6 * given["f0_mhz"],
        reference_hz=1e9 / given["counter_tick_ns"],
        frame_rate_hz=given["frame_rate_hz"],
        tolerances=tolerances,
    )


def _check_options(options: argparse.Namespace) -> None:
    findings = []
    if (options.grid is None) != (options.pitch_mm is None):
        findings.append("--grid and --pitch-mm belong together: give both or neither, as --grid 4x4 --pitch-mm 5")
    if options.sensitivity_ppm_per_newton == 0:
        findings.append("--sensitivity-ppm-per-newton 0: must not be zero; give the expected, signed value, as -6.3")
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


def _with_defaults(options: argparse.Namespace, plate: Plate | None) -> dict[str, Any]:
    defaults = _DEFAULTS
    if plate is not None:
        low, high = plate.thermal.range_kelvin
        defaults = {
            "f0_mhz": 1e-6 * plate.pilot_hz / (1.0 + PILOT_ABOVE),
            "force_max_newton": plate.force_max_newton,
            "temperature_span_kelvin": high - low,
            "counter_tick_ns": 1e9 / plate.counter.reference_hz,
            "frame_rate_hz": plate.counter.frame_rate_hz,
        }
    given = {name: getattr(options, name) for name in defaults}
    return {name: defaults[name] if value is None else value for name, value in given.items()}


def _positions_m(options: argparse.Namespace) -> Floats:
    """Return the sites (m, 2): a grid about the origin, row by row from the top (smallest y), or those of a file."""
    if options.grid is None:
        return read_positions_m(options.sites)
    x, y = ((np.arange(count) - (count - 1) / 2) * 1e-3 * options.pitch_mm for count in options.grid)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def read_positions_m(path: Path) -> Floats:
    """Read positions (m, 2) from lines of x_mm,y_mm, with or without these words as the first line.

    Raises
    ------
    UsageError
        No file that can be read, a line that is no position, or a position that was given before.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise UsageError(f"--sites: {path}: cannot be read: {meaning_of(error)}") from None
    places: list[tuple[float, ...]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or (number == 1 and line.replace(" ", "") == "x_mm,y_mm"):
            continue
        try:
            place = tuple(float(part) for part in line.split(","))
        except ValueError:
            place = ()
        if len(place) != 2 or place in places or not all(abs(value) <= 10_000 for value in place):
            raise UsageError(
                f"--sites: {path}:{number}: got {line[:60]!r}; must be x_mm,y_mm within +-10000, each position once, "
                "as -6.1,4.2"
            )
        places.append(place)
    if not places:
        raise UsageError(f"--sites: {path}: no positions; give lines of x_mm,y_mm, as -6.1,4.2")
    return np.array(places) * 1e-3


def _within_a_rectangle(positions_m: Floats) -> tuple[tuple[int, ...], Floats, Floats, Floats]:
    """Return ids, sites, outline and transducers: half the typical distance around sites, transducers at corners."""
    nearest_m, _ = cKDTree(positions_m).query(positions_m, k=[2])
    typical_m = float(np.median(nearest_m)) if len(positions_m) > 1 else 0.0
    border_m = max(LEAST_BORDER_M, typical_m / 2)
    (x0, y0), (x1, y1) = positions_m.min(axis=0) - border_m, positions_m.max(axis=0) + border_m
    corners_m = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    return tuple(range(1, len(positions_m) + 1)), positions_m, corners_m, corners_m
