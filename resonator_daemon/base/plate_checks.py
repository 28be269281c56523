"""Checks of a plate file that depend on several keys."""

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core import InitErrorDetails

from resonator_daemon.base.plate_tables import (
    FORCE_SIGNAL,
    FORCE_SIGNALS,
    SKIN_SIGNALS,
    TEMPERATURE_SIGNAL,
    Counter,
    Grid,
    Outline,
    Point,
    Site,
)
from resonator_daemon.base.toml.reading import Number, finding

_MAX_TONES = 46_872  # 63 parts of 744 tones a channel: a frame has at most 255 parts
_SPREAD_SITES = 4
_GATE_TICKS_LIMIT = 1 << 32  # times within a record have 32 bits
_MAX_SHIFT = 0.1  # |K F| above this is a wrong unit of K: no resonator shifts so far
_Positive = Annotated[Number, Field(gt=0)]


def findings(raw: dict[str, Any]) -> Iterator[InitErrorDetails]:
    """Yield findings that depend on several keys, of those parts of a parsed file that are valid by themselves."""
    outline = _sound(Outline, raw.get("outline_mm")) or ()
    if outline and _area(outline) == 0:
        yield finding(("outline_mm",), outline, "encloses no area; give the corners in their order")
        outline = ()
    for index, transducer in enumerate(_sound(tuple[Point, ...], raw.get("transducers_mm")) or ()):
        if outline and not _inside(transducer, outline):
            yield finding(("transducers_mm", index), transducer, "lies outside outline_mm")
    if ("sites" in raw) == ("grid" in raw):
        yield finding(("sites",), None, "a plate has either [[sites]] or a [grid], not both or neither")
    sites = dict(_sound_sites(raw.get("sites")))
    yield from _site_findings(sites, outline)
    if force_max_newton := _sound(_Positive, raw.get("force_max_newton")):
        yield from _shift_findings(sites, force_max_newton)
    if grid := _sound(Grid, raw.get("grid")):
        yield from _grid_findings(grid, outline)
    signals = {tone.signal for site in sites.values() for tone in site.tones} | set(SKIN_SIGNALS if grid else ())
    if signals & set(FORCE_SIGNALS) and signals & set(SKIN_SIGNALS):
        yield finding(("sites",), sorted(signals), "mixes force and skin tones; a plate has either")
    if signals & set(SKIN_SIGNALS) and "skin" not in raw:
        yield finding(("skin",), None, "a plate with skin signals needs a [skin]: its elastic constants and its depth")
    counter = raw.get("counter")
    yield from _gate_findings(_sound(Counter, counter))
    kind = counter.get("kind") if isinstance(counter, dict) else None
    if kind == "single-tone" and signals - {FORCE_SIGNAL}:
        sentence = "one captured tone per corner carries forces alone; use 'channelised'"
        yield finding(("counter", "kind"), kind, sentence)
    if kind == "channelised":
        yield from _sign_findings(sites)
    if "spread_width_mm" in raw and len(sites) < _SPREAD_SITES:
        sentence = (
            f"needs at least {_SPREAD_SITES} sites, there are {len(sites)}: fewer cannot determine a place and a force"
        )
        yield finding(("spread_width_mm",), raw["spread_width_mm"], sentence)
    if "spread_width_mm" in raw and (kind == "single-tone" or "load_sharing_exponent" in raw):
        sentence = "belongs to a channelised counter of force sites; with captured tones give load_sharing_exponent"
        yield finding(("spread_width_mm",), raw["spread_width_mm"], sentence)


def _sound(kind: Any, raw: object) -> Any:
    """Return the value if it is valid by itself, else None."""
    return _accepted(TypeAdapter(kind), raw)


def _accepted(adapter: TypeAdapter[Any], raw: object) -> Any:
    try:
        return adapter.validate_python(raw)
    except ValidationError:
        return None


def _sound_sites(raw: object) -> Iterator[tuple[int, Site]]:
    adapter = TypeAdapter(Site)
    for index, table in enumerate(raw if isinstance(raw, list) else []):
        if site := _accepted(adapter, table):
            yield index, site


def _site_findings(sites: dict[int, Site], outline: tuple[Point, ...]) -> Iterator[InitErrorDetails]:
    ids: dict[int, int] = {}
    positions: dict[tuple[float, float], int] = {}
    for index, site in sites.items():
        if (first := ids.setdefault(site.id, index)) != index:
            yield finding(("sites", index, "id"), site.id, f"is the id of sites[{first}] already; ids differ")
        if (first := positions.setdefault(site.position_mm, index)) != index:
            sentence = f"is the position of sites[{first}] already; sites differ in place"
            yield finding(("sites", index, "position_mm"), site.position_mm, sentence)
        if outline and not _inside(site.position_mm, outline):
            yield finding(("sites", index, "position_mm"), site.position_mm, "lies outside outline_mm")
        names = [tone.signal for tone in site.tones]
        if set(names) & set(SKIN_SIGNALS) and sorted(names) != sorted(SKIN_SIGNALS):
            sentence = f"a skin site has one tone for each of {', '.join(SKIN_SIGNALS)}"
            yield finding(("sites", index, "tones"), names, sentence)
        if set(names) & set(FORCE_SIGNALS) and (names.count(FORCE_SIGNAL) != 1 or names.count(TEMPERATURE_SIGNAL) > 1):
            sentence = "a force site has one tone for its force, and at most one for its temperature"
            yield finding(("sites", index, "tones"), names, sentence)
    if sum(len(site.tones) for site in sites.values()) > _MAX_TONES:
        yield finding(("sites",), None, f"at most {_MAX_TONES} tones fit into a frame")


def _grid_findings(grid: Grid, outline: tuple[Point, ...]) -> Iterator[InitErrorDetails]:
    if sorted(grid.signals) != sorted(SKIN_SIGNALS):
        yield finding(("grid", "signals"), grid.signals, f"must name each of {', '.join(SKIN_SIGNALS)} once")
    if grid.tone_count > _MAX_TONES:
        yield finding(("grid", "shape"), grid.shape, f"gives {grid.tone_count} tones; at most {_MAX_TONES} fit")
        return
    if (used := np.unique(grid.tone_numbers).size) < grid.tone_count:
        sentence = f"gives {used} different tone numbers to {grid.tone_count} tones; choose steps that number each once"
        yield finding(("grid", "order"), grid.order, sentence)
    outside = [point for point in grid.site_positions_mm.tolist() if outline and not _inside(point, outline)]
    if outside:
        sentence = f"puts {len(outside)} sites outside outline_mm, the first at {outside[0]} mm"
        yield finding(("grid", "pitch_mm"), grid.pitch_mm, sentence)


def _gate_findings(counter: Counter | None) -> Iterator[InitErrorDetails]:
    if counter and not 1 <= counter.reference_hz / counter.frame_rate_hz < _GATE_TICKS_LIMIT:
        low_hz, high_hz = counter.reference_hz / _GATE_TICKS_LIMIT, counter.reference_hz
        sentence = (
            f"must be above {low_hz:g} and at most {high_hz:g}: a frame lasts 1 to 2^32 - 1 ticks of reference_hz"
        )
        yield finding(("counter", "frame_rate_hz"), counter.frame_rate_hz, sentence)


def _shift_findings(sites: dict[int, Site], force_max_newton: float) -> Iterator[InitErrorDetails]:
    for index, site in sites.items():
        for number, tone in enumerate(site.tones):
            largest = max(tone.sensitivity, key=abs)
            if tone.signal == FORCE_SIGNAL and abs(largest) * force_max_newton > _MAX_SHIFT:
                at_most = _MAX_SHIFT / force_max_newton
                sentence = f"must be within +-{at_most:g}, a shift of 10 % at force_max_newton; K is in 1/N, as -6.3e-6"
                yield finding(("sites", index, "tones", number, "sensitivity"), largest, sentence)


def _sign_findings(sites: dict[int, Site]) -> Iterator[InitErrorDetails]:
    for index, site in sites.items():
        for number, tone in enumerate(site.tones):
            if tone.signal in FORCE_SIGNALS and min(tone.sensitivity) < 0 < max(tone.sensitivity):
                sentence = (
                    "must have one sign: a channelised counter combines the corners of a tone, and opposite shifts "
                    "cancel; correct the sign of a corner, or use counter.kind = 'single-tone'"
                )
                yield finding(("sites", index, "tones", number, "sensitivity"), tone.sensitivity, sentence)


def _area(outline: tuple[Point, ...]) -> float:
    return sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(outline, outline[1:] + outline[:1], strict=True)) / 2


def _inside(point: Sequence[float], outline: tuple[Point, ...]) -> bool:
    """Return whether a point lies within a polygon or on its border, by the parity of the borders to its right."""
    x, y = point
    odd = False
    for (ax, ay), (bx, by) in zip(outline, outline[1:] + outline[:1], strict=True):
        length = math.hypot(bx - ax, by - ay)
        across = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        along = (x - ax) * (bx - ax) + (y - ay) * (by - ay)
        if length > 0 and abs(across) <= 1e-9 * length and 0 <= along <= length**2:
            return True
        if (ay > y) != (by > y) and (across > 0) == (by > ay):
            odd = not odd
    return odd
