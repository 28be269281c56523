"""The plate file that planned codes make."""

import json
import math
import tomllib
from pathlib import Path
from typing import Final

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.errors import ConfigurationError, UsageError
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.toml import TomlFile, load_model
from resonator_daemon.estimate.forces.force_sites import DEFAULT_COEFFICIENT_STD
from resonator_daemon.extensions.planning.request import PILOT_ABOVE, Request

REFERENCE_KELVIN: Final = 298.15


def plate_file_text(name: str, request: Request, f0_hz: Floats, *, codes_may_overlap: bool) -> str:
    """Return a plate file for a single-tone counter; f0 (m, channels)."""
    tolerances, exponent = request.tolerances, request.load_sharing_exponent
    low, high = (REFERENCE_KELVIN + sign * tolerances.temperature_span_kelvin / 2 for sign in (-1, 1))
    lines = [
        "# Codes from `resonatord plan codes`: f0_hz and sensitivity are what is aimed at. Calibrate before use.",
        "format = 1",
        f"name = {json.dumps(name[:100], ensure_ascii=False)}",
        f"outline_mm = {_points_mm(request.outline_m)}",
        f"transducers_mm = {_points_mm(request.transducers_m)}",
        f"force_max_newton = {_number(tolerances.force_max_newton)}",
        *([f"load_sharing_exponent = {_number(exponent)}"] if exponent else []),
        "",
        "[counter]",
        'kind = "single-tone"',
        f"reference_hz = {_number(request.reference_hz)}",
        f"frame_rate_hz = {_number(request.frame_rate_hz)}",
        f"pilot_hz = {_number(round(float(f0_hz.max()) * (1 + PILOT_ABOVE), 1))}",
        *(["codes_may_overlap = true"] if codes_may_overlap else []),
        "",
        "[thermal]",
        f"reference_kelvin = {_number(REFERENCE_KELVIN)}",
        f"range_kelvin = [{_number(low)}, {_number(high)}]",
        f"coefficient_std = {_number(DEFAULT_COEFFICIENT_STD)}",
        "",
        "[calibration]",
        f"sensitivity_std = {_number(tolerances.sensitivity_spread / math.sqrt(3.0))}",
    ]
    for site_id, position_m, tones, ratios in zip(
        request.site_ids, request.positions_m, f0_hz, request.sensitivity, strict=True
    ):
        lines += [
            "",
            "[[sites]]",
            f"id = {site_id}",
            f"position_mm = {_points_mm(position_m[None])[1:-1]}",
            "[[sites.tones]]",
            'signal = "force"',
            f"f0_hz = [{', '.join(_number(round(float(tone), 1)) for tone in tones)}]",
            f"sensitivity = [{', '.join(_number(float(ratio)) for ratio in ratios)}]",
        ]
    return "\n".join(lines) + "\n"


def planned_plate(text: str) -> Plate:
    """Return the plate of a text; UsageError names what cannot be."""
    try:
        return load_model(Plate, TomlFile(Path("the planned plate"), text, tomllib.loads(text)))
    except ConfigurationError as error:
        raise UsageError(error.messages[0]) from None


def _points_mm(points_m: Floats) -> str:
    return "[" + ", ".join(f"[{_number(1e3 * x)}, {_number(1e3 * y)}]" for x, y in points_m.tolist()) + "]"


def _number(value: float) -> str:
    return repr(float(f"{value:.12g}"))
