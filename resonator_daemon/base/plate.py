"""Model of a plate file and its checks: sites, their tones and the counter, as arrays in SI units."""

from __future__ import annotations

import math
import os.path
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ModelWrapValidatorHandler, TypeAdapter, ValidationError, model_validator
from pydantic_core import InitErrorDetails

from firmware_protocol.layouts import BLOCK_STRUCT, CHANNEL_COUNT, SINGLE_TONE_STRUCT, TONE_STRUCT
from firmware_protocol.packets import MAX_PAYLOAD_BYTES, PACKET_OVERHEAD_BYTES
from resonator_daemon.base.arrays import Floats, Integers
from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.plate_tables import (
    FORCE_SIGNAL,
    FORCE_SIGNALS,
    SKIN_SIGNALS,
    TEMPERATURE_SIGNAL,
    Calibration,
    Corners,
    Counter,
    Grid,
    Outline,
    Point,
    Response,
    Site,
    Skin,
    Thermal,
    of_length,
)
from resonator_daemon.base.toml import Number, Table, check_with, finding, load_model, nearest, read_toml

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
    transducers = _sound(tuple[Point, ...], raw.get("transducers_mm")) or ()
    for index, transducer in enumerate(transducers):
        if transducer in transducers[:index]:
            yield finding(("transducers_mm", index), transducer, "is the position of another transducer")
        if outline and not _inside(transducer, outline):
            yield finding(("transducers_mm", index), transducer, "lies outside outline_mm")
    if ("sites" in raw) == ("grid" in raw):
        yield finding(("sites",), None, "a plate has either [[sites]] or a [grid], not both or neither")
    listed = raw.get("sites")
    parsed = {index: _sound(Site, table) for index, table in enumerate(listed if isinstance(listed, list) else [])}
    sites = {index: site for index, site in parsed.items() if site}
    yield from _site_findings(sites, outline)
    if grid := _sound(Grid, raw.get("grid")):
        yield from _grid_findings(grid, outline)
    signals = {tone.signal for site in sites.values() for tone in site.tones} | set(SKIN_SIGNALS if grid else ())
    if signals & set(FORCE_SIGNALS) and signals & set(SKIN_SIGNALS):
        yield finding(("sites",), sorted(signals), "mixes force and skin tones; a plate has either")
    if signals & set(SKIN_SIGNALS) and "skin" not in raw:
        yield finding(("skin",), None, "a plate with skin signals needs a [skin]: its elastic constants and its depth")
    counter = raw.get("counter")
    yield from _counter_findings(_sound(Counter, counter), sites)
    kind = counter.get("kind") if isinstance(counter, dict) else None
    if kind == "single-tone" and signals - {FORCE_SIGNAL}:
        sentence = "one captured tone per corner carries forces alone; use 'channelised'"
        yield finding(("counter", "kind"), kind, sentence)
    yield from _tone_findings(sites, _sound(_Positive, raw.get("force_max_newton")) or 0.0, kind)
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
    try:
        return TypeAdapter(kind).validate_python(raw)
    except ValidationError:
        return None


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


def _counter_findings(counter: Counter | None, sites: dict[int, Site]) -> Iterator[InitErrorDetails]:
    if counter and not 1 <= counter.reference_hz / counter.frame_rate_hz < _GATE_TICKS_LIMIT:
        low_hz, high_hz = counter.reference_hz / _GATE_TICKS_LIMIT, counter.reference_hz
        sentence = (
            f"must be above {low_hz:g} and at most {high_hz:g}: a frame lasts 1 to 2^32 - 1 ticks of reference_hz"
        )
        yield finding(("counter", "frame_rate_hz"), counter.frame_rate_hz, sentence)
    if counter and any(counter.pilot_hz in tone.f0_hz for site in sites.values() for tone in site.tones):
        sentence = (
            "is a site's f0_hz: a touch could not be distinguished from none; choose a frequency that no site has"
        )
        yield finding(("counter", "pilot_hz"), counter.pilot_hz, sentence)


def _tone_findings(sites: dict[int, Site], force_max_newton: float, kind: object) -> Iterator[InitErrorDetails]:
    for index, number, tone in ((i, n, tone) for i, site in sites.items() for n, tone in enumerate(site.tones)):
        place = ("sites", index, "tones", number, "sensitivity")
        largest = max(tone.sensitivity, key=abs)
        if tone.signal == FORCE_SIGNAL and abs(largest) * force_max_newton > _MAX_SHIFT:
            at_most = _MAX_SHIFT / force_max_newton
            sentence = f"must be within +-{at_most:g}, a shift of 10 % at force_max_newton; K is in 1/N, as -6.3e-6"
            yield finding(place, largest, sentence)
        if kind == "channelised" and tone.signal in FORCE_SIGNALS and min(tone.sensitivity) < 0 < max(tone.sensitivity):
            sentence = (
                "must have one sign: a channelised counter combines the corners of a tone, and opposite shifts "
                "cancel; correct the sign of a corner, or use counter.kind = 'single-tone'"
            )
            yield finding(place, tone.sensitivity, sentence)


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


Item = TypeVar("Item", bound=np.generic)

_SHIPPED = Path(__file__).with_name("plates")


@dataclass(frozen=True, eq=False)
class ToneTable:
    """All tones of a plate in the order in which the board numbers them."""

    site_index: Integers  # (t,) into site_ids
    signal_index: Integers  # (t,) into signals
    f0_hz: Floats  # (t, 4)
    sensitivity: Floats  # (t, 4), 1/N, 1/K, 1/Pa or 1/strain
    temperature_coefficients: Floats  # (t, 3), NaN where the file does not give them


class Plate(Table):
    """A plate file, checked as a whole; its arrays are in SI units and read-only."""

    format: Literal[1]
    name: Annotated[str, Field(min_length=1, max_length=100)]
    outline_mm: Outline
    transducers_mm: Annotated[tuple[Point, ...], Corners]
    force_max_newton: Annotated[Number, Field(ge=1e-6, le=10_000)]
    # A touch between sites is shared as distance^-exponent; None where sites can only be touched one by one.
    load_sharing_exponent: Annotated[Number, Field(gt=0, le=100)] | None = None
    # Under a cover of this width w a touch at distance r loads a site with (1 + r^2/w^2)^(-3/2) of its force.
    spread_width_mm: Annotated[Number, Field(ge=0.01, le=1000)] | None = None
    counter: Counter
    thermal: Thermal = Thermal()
    response: Response | None = None
    skin: Skin | None = None
    grid: Grid | None = None
    sites: Annotated[tuple[Site, ...], of_length(1, "[[sites]]", or_more=True)] = ()
    calibration: Calibration = Calibration()

    @model_validator(mode="wrap")
    @classmethod
    def _every_finding_at_once(cls, raw: Any, handler: ModelWrapValidatorHandler[Plate]) -> Plate:
        return check_with(list(findings(raw)) if isinstance(raw, dict) else [], handler, raw)

    @cached_property
    def outline_m(self) -> Floats:
        """(k, 2) corners of the outline."""
        return _fixed(np.array(self.outline_mm) * 1e-3)

    @cached_property
    def transducers_m(self) -> Floats:
        """(4, 2), by channel."""
        return _fixed(np.array(self.transducers_mm) * 1e-3)

    @cached_property
    def site_ids(self) -> Integers:
        """(n,) ids; those of a grid count from 1."""
        if self.grid:
            return _fixed(np.arange(1, self.grid.shape[0] * self.grid.shape[1] + 1))
        return _fixed(np.array([site.id for site in self.sites]))

    @cached_property
    def site_positions_m(self) -> Floats:
        """(n, 2)."""
        positions_mm = self.grid.site_positions_mm if self.grid else np.array([s.position_mm for s in self.sites])
        return _fixed(positions_mm * 1e-3)

    @cached_property
    def signals(self) -> tuple[str, ...]:
        """What tones carry: those of FORCE_SIGNALS that the plate has, or SKIN_SIGNALS, each in its order."""
        if self.grid or self.sites[0].tones[0].signal in SKIN_SIGNALS:
            return SKIN_SIGNALS
        present = {tone.signal for site in self.sites for tone in site.tones}
        return tuple(signal for signal in FORCE_SIGNALS if signal in present)

    @property
    def default_sensor(self) -> str:
        """Kind of sensor that the plate with its counter amounts to, an entry of `resonatord.sensors`."""
        if self.skin is not None:
            return "skin"
        return "single-tone" if self.counter.kind == "single-tone" else "multitone"

    @property
    def decodable(self) -> bool:
        """Whether its signals are decoded to the traction on a surface, which may be touched anywhere."""
        return self.skin is not None

    @property
    def oscillators(self) -> int:
        """Number of oscillators that a board must describe for it; 0 for a counter that captures a tone."""
        return len(self.tones.f0_hz) if self.counter.frames_in_parts else 0

    @property
    def frame_bytes(self) -> int:
        """Size of one frame on the wire, packets' overhead included (PROTOCOL.md, sections 6 and 7)."""
        if not self.counter.frames_in_parts:
            return PACKET_OVERHEAD_BYTES + CHANNEL_COUNT * SINGLE_TONE_STRUCT.size
        tones = len(self.tones.f0_hz)
        parts = math.ceil(tones / ((MAX_PAYLOAD_BYTES - BLOCK_STRUCT.size) // TONE_STRUCT.size))
        return CHANNEL_COUNT * (parts * (PACKET_OVERHEAD_BYTES + BLOCK_STRUCT.size) + tones * TONE_STRUCT.size)

    @property
    def required_skin(self) -> Skin:
        """The skin; ConfigurationError if there is none."""
        if self.skin is None:
            raise ConfigurationError(f"plate {self.name!r} has no [skin]")
        return self.skin

    @property
    def spread_width_m(self) -> float | None:
        return None if self.spread_width_mm is None else self.spread_width_mm * 1e-3

    @cached_property
    def pilot_hz(self) -> float:
        """Tone that a single-tone counter captures while nothing is touched; by default 0.1 % above all others."""
        return self.counter.pilot_hz or 1.001 * float(self.tones.f0_hz.max())

    @cached_property
    def tones(self) -> ToneTable:
        """Sites' tones in the order of the file; those of a grid by their number k."""
        if self.grid:
            return _grid_tones(self.grid)
        tones = [(index, tone) for index, site in enumerate(self.sites) for tone in site.tones]
        return ToneTable(
            _fixed(np.array([index for index, _ in tones])),
            _fixed(np.array([self.signals.index(tone.signal) for _, tone in tones])),
            _fixed(np.array([tone.f0_hz for _, tone in tones])),
            _fixed(np.array([tone.sensitivity for _, tone in tones])),
            _fixed(np.array([tone.temperature_coefficients or (math.nan,) * 3 for _, tone in tones])),
        )


def shipped_plates() -> tuple[str, ...]:
    """Return the names of the plates that come with the daemon."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


def load_plate(name_or_path: str, *, relative_to: Path | None = None) -> Plate:
    """Load a shipped plate by its name, or a plate file by its path.

    Raises
    ------
    ConfigurationError
        Neither a shipped name nor a readable file, or a file with findings: all of them.
    """
    shipped = shipped_plates()
    if name_or_path in shipped:
        return load_model(Plate, read_toml(_SHIPPED / f"{name_or_path}.toml"))
    path = (relative_to or Path()) / name_or_path
    if not os.path.exists(path):  # Path.exists raises on names that are too long
        raise ConfigurationError(
            f"no shipped plate and no file is named {name_or_path!r}; {nearest(name_or_path, shipped)}"
        )
    return load_model(Plate, read_toml(path))


def _fixed(array: NDArray[Item]) -> NDArray[Item]:
    array.setflags(write=False)
    return array


def _grid_tones(grid: Grid) -> ToneTable:
    by_number = np.argsort(grid.tone_numbers, axis=None)
    site_index, component = np.divmod(by_number, len(grid.signals))
    f0_hz = grid.f0_hz + np.arange(grid.tone_count) * grid.spacing_hz
    signal_index = np.array([SKIN_SIGNALS.index(signal) for signal in grid.signals])
    return ToneTable(
        _fixed(site_index),
        _fixed(signal_index[component]),
        _fixed(np.repeat(f0_hz[:, None], CHANNEL_COUNT, axis=1)),
        _fixed(np.repeat(np.array(grid.sensitivity)[component, None], CHANNEL_COUNT, axis=1)),
        _fixed(np.full((grid.tone_count, 3), math.nan)),
    )
