"""Where the sites of a planned plate are, and the plate file that its codes make."""

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.errors import ConfigurationError, UsageError, meaning_of
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.toml import TomlFile, load_model
from resonator_daemon.estimate.forces.force_sites import DEFAULT_COEFFICIENT_STD

LEAST_BORDER_M: Final = 2e-3
PILOT_ABOVE: Final = 1e-3  # the tone that no code has, relative
REFERENCE_KELVIN: Final = 298.15


@dataclass(frozen=True, eq=False)
class Layout:
    """Ids (m,), positions (m, 2), outline (k, 2) and transducers (4, 2)."""

    site_ids: tuple[int, ...]
    positions_m: Floats
    outline_m: Floats
    transducers_m: Floats


def grid_layout(columns: int, rows: int, pitch_m: float) -> Layout:
    """Put sites on a grid about the origin, row by row from below."""
    x, y = ((np.arange(count) - (count - 1) / 2) * pitch_m for count in (columns, rows))
    return _within_a_rectangle(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))


def read_layout(path: Path) -> Layout:
    """Read positions from lines of x_mm,y_mm, with or without these words as the first line.

    Raises
    ------
    ConfigurationError
        No file that can be read, or lines that are no position: all of them.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {meaning_of(error)}") from None
    findings: list[str] = []
    places: dict[tuple[float, float], int] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip() or (number == 1 and line.replace(" ", "") == "x_mm,y_mm"):
            continue
        place = _place_mm(line)
        if place is None:
            findings.append(f"{path}:{number}: got {line[:60]!r}; must be x_mm,y_mm within +-10000, as -6.1,4.2")
        elif place in places:
            findings.append(f"{path}:{number}: {line.strip()} is the position of line {places[place]} already")
        else:
            places[place] = number
    if findings or not places:
        raise ConfigurationError(*(findings or [f"{path}: no positions; give lines of x_mm,y_mm, as -6.1,4.2"]))
    return _within_a_rectangle(np.array(list(places)) * 1e-3)


def plate_layout(plate: Plate) -> Layout:
    """Return the layout of a plate that there is."""
    ids = tuple(int(site_id) for site_id in plate.site_ids)
    return Layout(ids, plate.site_positions_m, plate.outline_m, plate.transducers_m)


def _place_mm(line: str) -> tuple[float, float] | None:
    try:
        x_mm, y_mm = (float(part) for part in line.split(","))
    except ValueError:
        return None
    return (x_mm, y_mm) if abs(x_mm) <= 10_000 and abs(y_mm) <= 10_000 else None


def _within_a_rectangle(positions_m: Floats) -> Layout:
    """Return the layout of the sites: half their typical distance around them, a transducer at each corner."""
    nearest_m, _ = cKDTree(positions_m).query(positions_m, k=[2])
    typical_m = float(np.median(nearest_m)) if len(positions_m) > 1 else 0.0
    border_m = max(LEAST_BORDER_M, typical_m / 2)
    (x0, y0), (x1, y1) = positions_m.min(axis=0) - border_m, positions_m.max(axis=0) + border_m
    corners_m = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    return Layout(tuple(range(1, len(positions_m) + 1)), positions_m, corners_m, corners_m)


@dataclass(frozen=True)
class PlateDraft:
    """What of a plate file is not in its layout and codes."""

    name: str
    force_max_newton: float
    reference_hz: float
    frame_rate_hz: float
    temperature_span_kelvin: float
    sensitivity_std: float
    codes_may_overlap: bool = False
    load_sharing_exponent: float | None = None


def plate_file_text(layout: Layout, f0_hz: Floats, sensitivity: Floats, draft: PlateDraft) -> str:
    """Return a plate file for a single-tone counter; f0 and K in 1/N, (m, channels)."""
    low, high = (REFERENCE_KELVIN + sign * draft.temperature_span_kelvin / 2 for sign in (-1, 1))
    lines = [
        "# Codes from `resonatord plan codes`: f0_hz and sensitivity are what is aimed at. Calibrate before use.",
        "format = 1",
        f"name = {json.dumps(draft.name[:100], ensure_ascii=False)}",
        f"outline_mm = {_points_mm(layout.outline_m)}",
        f"transducers_mm = {_points_mm(layout.transducers_m)}",
        f"force_max_newton = {_number(draft.force_max_newton)}",
        *([f"load_sharing_exponent = {_number(draft.load_sharing_exponent)}"] if draft.load_sharing_exponent else []),
        "",
        "[counter]",
        'kind = "single-tone"',
        f"reference_hz = {_number(draft.reference_hz)}",
        f"frame_rate_hz = {_number(draft.frame_rate_hz)}",
        f"pilot_hz = {_number(round(float(f0_hz.max()) * (1 + PILOT_ABOVE), 1))}",
        *(["codes_may_overlap = true"] if draft.codes_may_overlap else []),
        "",
        "[thermal]",
        f"reference_kelvin = {_number(REFERENCE_KELVIN)}",
        f"range_kelvin = [{_number(low)}, {_number(high)}]",
        f"coefficient_std = {_number(DEFAULT_COEFFICIENT_STD)}",
        "",
        "[calibration]",
        f"sensitivity_std = {_number(draft.sensitivity_std)}",
    ]
    for site_id, position_m, tones, ratios in zip(layout.site_ids, layout.positions_m, f0_hz, sensitivity, strict=True):
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
