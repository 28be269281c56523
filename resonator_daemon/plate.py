"""The plate file's model: sites, their tones and the counter, as SI arrays for everyone who measures or emulates."""

from __future__ import annotations

import math
import os.path
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ModelWrapValidatorHandler,
    Strict,
    StrictBool,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import InitErrorDetails

from firmware_protocol.layouts import BLOCK_STRUCT, CHANNEL_COUNT, SINGLE_TONE_STRUCT, TONE_STRUCT
from firmware_protocol.packets import MAX_PAYLOAD_BYTES, PACKET_OVERHEAD_BYTES
from resonator_daemon.arrays import Floats, Integers
from resonator_daemon.errors import ConfigurationError
from resonator_daemon.toml_files.reading import (
    Count,
    Number,
    Table,
    check_with,
    finding,
    load_model,
    nearest,
    read_toml,
)

Item = TypeVar("Item", bound=np.generic)

FORCE_SIGNAL: Final = "force"
TEMPERATURE_SIGNAL: Final = "temperature"
FORCE_SIGNALS: Final = (FORCE_SIGNAL, TEMPERATURE_SIGNAL)
SKIN_SIGNALS = ("p_n", "eps_xz", "eps_yz")  # the order of everything that is published or decoded

_MAX_TONES = 46_872  # 63 parts of 744 tones a channel: a frame has at most 255 parts
_SPREAD_SITES = 4
_MAX_SHIFT = 0.1  # |K F| beyond this is a slip of the unit, not a resonator
_SHIPPED = Path(__file__).with_name("plates")


def _of_length(length: int, what: str) -> BeforeValidator:
    def check(values: object) -> object:
        if not isinstance(values, list | tuple) or len(values) != length:
            raise ValueError(f"must be a list of {length}: {what}")
        return values

    return BeforeValidator(check)


def _at_least(length: int, what: str) -> BeforeValidator:
    """Not pydantic's min_length: that one counts only those items that are sound."""

    def check(values: object) -> object:
        if not isinstance(values, list | tuple) or len(values) < length:
            raise ValueError(f"must be a list of at least {length}: {what}")
        return values

    return BeforeValidator(check)


_MIN_SENSITIVITY = 1e-15


def _nonzero(value: float) -> float:
    if abs(value) < _MIN_SENSITIVITY:
        raise ValueError("must not be zero: a site without sensitivity cannot be read; give the measured, signed value")
    return value


def _rising(limits: tuple[float, ...]) -> tuple[float, ...]:
    if not limits[0] < limits[1]:
        raise ValueError("must rise: the lowest, then the highest")
    return limits


Millimetres = Annotated[Number, Field(ge=-10_000, le=10_000)]
Point = Annotated[tuple[Millimetres, Millimetres], _of_length(2, "x and y")]
Outline = Annotated[tuple[Point, ...], _at_least(3, "corners, each [x, y]")]
Positive = Annotated[Number, Field(gt=0)]
Hertz = Annotated[Number, Field(gt=0, le=1e12)]
Sensitivity = Annotated[Number, Field(ge=-1e6, le=1e6), AfterValidator(_nonzero)]
Day = Annotated[date, Strict()]
Kelvin = Annotated[Number, Field(ge=100, le=600)]
_Corners = _of_length(CHANNEL_COUNT, "one for each corner")


CounterType = Literal["single-tone", "channelised"]


class Counter(Table):
    """Kind, clock and frame rate of the board's counter."""

    kind: CounterType
    reference_hz: Annotated[Hertz, Field(default_factory=lambda seen: _default(seen, 1e9, 250e6))]
    frame_rate_hz: Annotated[
        Number, Field(gt=0, le=100_000, default_factory=lambda seen: _default(seen, 1000.0, 100.0))
    ]
    pilot_hz: Hertz | None = None  # captured by a single-tone counter while nothing is touched; see Plate.pilot_hz
    codes_may_overlap: StrictBool = False  # take a plate whose sites can be mistaken for each other all the same

    @property
    def frames_in_parts(self) -> bool:
        """Whether a frame is sent in parts, each with some tones of one channel, and not as one packet."""
        return self.kind == "channelised"

    @field_validator("pilot_hz")
    @classmethod
    def _only_a_single_tone_counter_has_a_pilot(cls, pilot_hz: float | None, info: ValidationInfo) -> float | None:
        if info.data.get("kind") == "channelised" and pilot_hz is not None:
            raise ValueError("belongs to a single-tone counter; leave it out")
        return pilot_hz


def _default(seen: dict[str, Any], single_tone: float, channelised: float) -> float:
    return channelised if seen.get("kind") == "channelised" else single_tone


class Skin(Table):
    """The elastic half-space above the sites."""

    youngs_modulus_pascal: Annotated[Number, Field(ge=1, le=1e13)]
    poisson_ratio: Annotated[Number, Field(ge=0, le=0.5)]
    depth_mm: Annotated[Number, Field(ge=0.001, le=1000)]
    gain_std: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    # Of the decoder's prior, as `resonatord calibrate skin` finds them.
    correlation_length_mm: Annotated[Number, Field(ge=0.01, le=100)] = 1.0
    tangential_ratio: Annotated[Number, Field(ge=0.001, le=100)] = 0.3

    @property
    def depth_m(self) -> float:
        return self.depth_mm * 1e-3

    @property
    def correlation_length_m(self) -> float:
        return self.correlation_length_mm * 1e-3


class Grid(Table):
    """Sites and tones of a skin by rule: tone k = (order . (ix, iy, signal)) mod tones lies at f0_hz + k spacing_hz."""

    shape: Annotated[tuple[Annotated[Count, Field(ge=1, le=65_535)], ...], _of_length(2, "ny and nx")]
    pitch_mm: Annotated[Number, Field(gt=0, le=1000)]
    signals: Annotated[tuple[Literal["p_n", "eps_xz", "eps_yz"], ...], _of_length(3, "p_n, eps_xz and eps_yz")]
    f0_hz: Hertz
    spacing_hz: Hertz
    order: Annotated[tuple[Count, ...], _of_length(3, "steps for ix, iy and the signal")]
    sensitivity: Annotated[tuple[Sensitivity, ...], _of_length(3, "one for each signal")]

    @property
    def pitch_m(self) -> float:
        return self.pitch_mm * 1e-3

    @property
    def tone_count(self) -> int:
        return self.shape[0] * self.shape[1] * len(self.signals)

    @property
    def site_positions_mm(self) -> Floats:
        """(ny nx, 2), site index iy nx + ix, centred on the plate's origin."""
        ny, nx = self.shape
        iy, ix = np.divmod(np.arange(ny * nx), nx)
        return np.column_stack([ix - (nx - 1) / 2, iy - (ny - 1) / 2]) * self.pitch_mm

    @property
    def tone_numbers(self) -> Integers:
        """(ny nx, signals) the number k of each tone."""
        ny, nx = self.shape
        step_x, step_y, step_signal = (step % self.tone_count for step in self.order)
        iy, ix = np.divmod(np.arange(ny * nx, dtype=np.int64)[:, None], nx)
        signal = np.arange(len(self.signals), dtype=np.int64)
        numbers: Integers = (step_x * ix + step_y * iy + step_signal * signal) % self.tone_count
        return numbers


class Tone(Table):
    """One resonance of a site as the four corners see it."""

    signal: Literal["force", "temperature", "p_n", "eps_xz", "eps_yz"]
    f0_hz: Annotated[tuple[Hertz, ...], _Corners]
    sensitivity: Annotated[tuple[Sensitivity, ...], _Corners]
    # Relative shift by d = T - thermal.reference_kelvin: a d + b d^2 + c d^3, in 1/K, 1/K^2, 1/K^3.
    temperature_coefficients: Annotated[tuple[Number, ...], _of_length(3, "a, b and c")] | None = None


class Site(Table):
    """A place on the plate that senses: a force (and its own temperature), or the three signals under a skin."""

    id: Annotated[Count, Field(ge=1, le=65_535)]
    position_mm: Point
    tones: Annotated[tuple[Tone, ...], _at_least(1, "[[sites.tones]]")]


class Thermal(Table):
    """How warm plate and touches may be, and what of it is not known."""

    reference_kelvin: Kelvin = 298.15  # at which f0_hz holds
    range_kelvin: Annotated[tuple[Kelvin, ...], _of_length(2, "lowest and highest"), AfterValidator(_rising)] = (
        288.15,
        308.15,
    )
    coefficient_std: Annotated[Number, Field(ge=0, le=1e-3)] = 2e-8  # 1/K, of what the tones' coefficients are off by
    transient_s: Annotated[Number, Field(ge=-1, le=1)] = -2e-7  # relative shift for each K/s of a site
    contact_std_kelvin: Annotated[Number, Field(ge=0, le=1000)] = 0.0  # by which what touches differs from the plate
    contact_time_s: Annotated[Number, Field(gt=0, le=1e6)] = 5.0  # in which a touched site takes its temperature


class Response(Table):
    """What a force site feels of a press besides its force: hysteresis and creep, as calibrated."""

    hysteresis_newton: Annotated[Number, Field(ge=0, le=10_000)]
    creep_fraction: Annotated[Number, Field(ge=0, lt=0.5)]
    creep_time_s: Annotated[Number, Field(gt=0, le=1e6)]
    relative_std: Annotated[Number, Field(ge=0, le=1)] = 0.1  # of what they are off by


class Validity(Table):
    """Forces and temperatures at which a calibration was made."""

    force_newton: Annotated[tuple[Number, ...], _of_length(2, "lowest and highest"), AfterValidator(_rising)]
    kelvin: Annotated[tuple[Kelvin, ...], _of_length(2, "lowest and highest"), AfterValidator(_rising)]


class Coupling(Table):
    """Share of the force on one site that another one feels."""

    pressed: Count
    measured: Count
    ratio: Number


class Calibration(Table):
    """Where the numbers of this file come from, and what they are worth."""

    id: str | None = None
    date: Day | None = None
    unit: str | None = None  # serial number of the board and plate that were calibrated
    temperature_kelvin: Kelvin | None = None
    model_error: Annotated[Number, Field(gt=0, le=0.5)] = 0.015  # relative, of K from touch to touch and corner
    sensitivity_std: Annotated[Number, Field(ge=0, le=0.5)] = 0.0  # relative, of all K: the masses' own
    sites: tuple[Count, ...] = ()  # ids of those that were calibrated last, in the order of `residuals`
    residuals: tuple[Number, ...] = ()  # newton rms
    coupling: tuple[Coupling, ...] = ()
    validity: Validity | None = None
    expiry: Day | None = None

    def expired(self, today: Day) -> bool:
        return self.expiry is not None and today > self.expiry

    def expiry_note(self, today: Day) -> str | None:
        """Return a sentence if the calibration has expired, else None."""
        name = self.id or "of the plate file"
        return f"calibration {name} expired on {self.expiry}: calibrate again" if self.expired(today) else None


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
    transducers_mm: Annotated[tuple[Point, ...], _Corners]
    force_max_newton: Annotated[Number, Field(gt=0, le=10_000)]
    # A touch between sites is shared as distance^-exponent; None where sites can only be touched one by one.
    load_sharing_exponent: Annotated[Number, Field(gt=0, le=100)] | None = None
    # Under a cover of this width w a touch at distance r loads a site with (1 + r^2/w^2)^(-3/2) of its force.
    spread_width_mm: Annotated[Number, Field(ge=0.01, le=1000)] | None = None
    counter: Counter
    thermal: Thermal = Thermal()
    response: Response | None = None
    skin: Skin | None = None
    grid: Grid | None = None
    sites: Annotated[tuple[Site, ...], _at_least(1, "[[sites]]")] = ()
    calibration: Calibration = Calibration()

    @model_validator(mode="wrap")
    @classmethod
    def _every_finding_at_once(cls, raw: Any, handler: ModelWrapValidatorHandler[Plate]) -> Plate:
        return check_with(list(_findings(raw)) if isinstance(raw, dict) else [], handler, raw)

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
    def sensor_kind(self) -> Literal["single-tone", "multitone", "skin"]:
        """Kind of sensor that the plate with its counter amounts to."""
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
    def windowed(self) -> bool:
        """Whether readings are of windows of several frames."""
        return self.skin is None

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


def _findings(raw: dict[str, Any]) -> Iterator[InitErrorDetails]:
    """Check what depends on several keys, on those parts of the file that are sound by themselves."""
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
    if force_max_newton := _sound(Positive, raw.get("force_max_newton")):
        yield from _shift_findings(sites, force_max_newton)
    if grid := _sound(Grid, raw.get("grid")):
        yield from _grid_findings(grid, outline)
    signals = {tone.signal for site in sites.values() for tone in site.tones} | set(SKIN_SIGNALS if grid else ())
    if signals & set(FORCE_SIGNALS) and signals & set(SKIN_SIGNALS):
        yield finding(("sites",), sorted(signals), "mixes force and skin tones; a plate has either")
    if signals & set(SKIN_SIGNALS) and "skin" not in raw:
        yield finding(("skin",), None, "a plate with skin signals needs a [skin]: its elastic constants and its depth")
    counter = raw.get("counter")
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
    """Return the value where it is valid by itself, else None."""
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
