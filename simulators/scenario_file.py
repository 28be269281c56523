"""The scenario file: its tables and keys, the shipped ones, and the messages for invalid ones."""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, WithJsonSchema
from pydantic_core import ErrorDetails

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from simulators.arrays import Floats
from simulators.faults import FaultEvent, FaultPlan
from simulators.findings import message_of, nearest
from simulators.physics import Physics
from simulators.world import with_world, world_schema

_ON_SITE_M = 1e-9
_SHIPPED = Path(__file__).with_name("scenarios")

Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Kelvin = Annotated[float, Field(ge=100, le=600, allow_inf_nan=False, strict=True)]
Switch = Annotated[bool, Field(strict=True)]
Point = tuple[Finite, Finite]
TimedKelvin = tuple[NotNegative, Kelvin]

_POINTS = "give a number, or points [[t_s, kelvin], ...] with times that rise"


def _line(given: Any) -> Any:
    """Return a number as a line of constant height."""
    if isinstance(given, int | float):
        return [(0.0, given)]
    if not isinstance(given, list | tuple):
        raise ValueError(_POINTS)
    return given


def _rising(points: tuple[TimedKelvin, ...]) -> tuple[TimedKelvin, ...]:
    if not points or np.any(np.diff([time_s for time_s, _ in points]) <= 0):
        raise ValueError(_POINTS)
    return points


KelvinLine = Annotated[
    tuple[TimedKelvin, ...],
    BeforeValidator(_line, json_schema_input_type=Kelvin | tuple[TimedKelvin, ...]),
    AfterValidator(_rising),
]
WorldKeys = Annotated[dict[str, Any], WithJsonSchema(world_schema())]  # which `with_world` checks


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Shear(_Table):
    """Tangential force during the hold: from 0 to a share of what friction can carry, and back."""

    peak_ratio: Annotated[float, Field(gt=0, le=1, strict=True)] = Field(
        description="Largest tangential force, as a share of normal force times friction coefficient (0.5)."
    )
    direction_deg: Finite = Field(0.0, description="Where it points: 0 is x, 90 is y.")


class Touch(_Table):
    """One press of a site, of a place or of the whole plate: force rises, holds and falls, its ramps raised cosines."""

    start_s: NotNegative = Field(description="When the force begins to rise, from the first frame.")
    site: Annotated[int, Field(strict=True)] | None = Field(None, description="Id of the site that is touched.")
    position_mm: Point | None = Field(None, description="Place that is touched, [x, y].")
    whole_plate: Switch = Field(False, description="Presses every site at once, each with force_newton.")
    to_mm: Point | None = Field(None, description="Slides there in a straight line during the hold.")
    force_newton: Positive = Field(description="Normal force during the hold.")
    rise_s: NotNegative = Field(0.1, description="How long the force rises; 0 is an instant.")
    hold_s: NotNegative = Field(0.8, description="How long it is held.")
    fall_s: NotNegative = Field(0.1, description="How long it falls; 0 is an instant.")
    shear: Shear | None = Field(None, description="Tangential force besides the normal one; for plates with a skin.")
    kelvin: Kelvin | None = Field(None, description="Temperature of what touches; left out: that of the plate.")

    @property
    def duration_s(self) -> float:
        return self.rise_s + self.hold_s + self.fall_s


class ScenarioFile(_Table):
    """What happens to an emulated plate, and what it is like itself."""

    period_s: Positive | None = Field(None, description="After this the touches begin again; left out: play once.")
    environment_kelvin: KelvinLine = Field(
        ((0.0, 298.15),),
        description="Temperature around the plate: a number, or points [[t_s, kelvin], ...] joined by straight lines "
        "and held after the last.",
    )
    seed: Annotated[int, Field(ge=0, strict=True)] = Field(
        0, description="Of all that is random, where the command line gives none."
    )
    plate: Physics = Field(Physics(), description="Imperfections of plate, oscillators and counter.")
    world: WorldKeys = Field({}, description="How the emulated plate and its touches differ from the plate file.")
    faults: FaultPlan = Field(FaultPlan(), description="What goes wrong at the board and on its link.")
    touches: tuple[Touch, ...] = Field((), description="The presses; they may overlap.")


_SKIN_KEYS = {"touches.shear"}
_FORCE_KEYS = {"environment_kelvin", "touches.kelvin", "touches.to_mm", "touches.whole_plate"} | {
    f"plate.{key}" for key in set(Physics.model_fields) - {"ideal", "reference_error", "drop_rate"}
}


def shipped_scenarios() -> tuple[str, ...]:
    """Return the names of the scenarios that come with the emulator."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


TOUCHED_SITES = 16  # ids 1 to 16, by the scenario "touches"


def default_scenario(plate: Plate) -> str:
    """Return the name of the scenario that shows what a plate can do."""
    if FORCE_SIGNAL not in plate.signals:
        return "press-and-shear"
    return "touches" if set(range(1, TOUCHED_SITES + 1)) <= set(plate.site_ids.tolist()) else "still"


def reach_m(plate: Plate) -> tuple[Floats, Floats]:
    """Return the least and the largest x and y that can be touched."""
    return plate.outline_m.min(axis=0), plate.outline_m.max(axis=0)


def site_at(position_m: Floats, plate: Plate) -> int | None:
    """Return the id of the site that is exactly there, None where none is."""
    distance_m = np.hypot(*(plate.site_positions_m - position_m).T)
    nearest = int(distance_m.argmin())
    return int(plate.site_ids[nearest]) if distance_m[nearest] < _ON_SITE_M else None


def read_scenario(name_or_path: str, plate: Plate) -> ScenarioFile:
    """Read a shipped scenario by its name, or a scenario file by its path.

    Raises
    ------
    ValueError
        Neither a shipped name nor a readable file, or a file with findings: one line for each.
    """
    shipped = shipped_scenarios()
    path = _SHIPPED / f"{name_or_path}.toml" if name_or_path in shipped else Path(name_or_path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        near = nearest(name_or_path, shipped)
        raise ValueError(f"no shipped scenario and no file is named {name_or_path!r}; {near}") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # not TOML, or not UTF-8
        raise ValueError(f"{path}: not TOML: {error}") from None
    try:
        file = ScenarioFile.model_validate(content)
    except ValidationError as error:
        raise ValueError("\n".join(f"{path}: {_sentence(finding)}" for finding in error.errors())) from None
    if findings := list(_findings(content, file, plate)):
        raise ValueError("\n".join(f"{path}: {finding}" for finding in findings))
    return file


def _findings(content: dict[str, Any], file: ScenarioFile, plate: Plate) -> Iterator[str]:
    """Check the keys against each other."""
    kind, keys = ("a skin", _SKIN_KEYS) if FORCE_SIGNAL in plate.signals else ("force sites", _FORCE_KEYS)
    if useless := sorted(_given_keys(content) & keys):
        remedy = "leave it out, or take another plate"
        yield f"{', '.join(useless)}: only for plates with {kind}, and {plate.name} has none; {remedy}"
        return
    try:
        with_world(plate, table=file.world)
    except ValueError as error:
        yield str(error)
    for index, touch in enumerate(file.touches):
        key = f"touches[{index}]"
        yield from _place_findings(key, touch, plate)
        if file.period_s is not None and touch.duration_s > file.period_s:
            yield f"{key}: lasts {touch.duration_s:g} s; at most one period_s, {file.period_s:g} s"


def _given_keys(content: dict[str, Any]) -> set[str]:
    of_plate = {f"plate.{key}" for key in content.get("plate", {})}
    return {*content} | of_plate | {f"touches.{key}" for touch in content.get("touches", []) for key in touch}


def _place_findings(key: str, touch: Touch, plate: Plate) -> Iterator[str]:
    low_mm, high_mm = (corner_m * 1e3 for corner_m in reach_m(plate))
    site_ids = plate.site_ids.tolist()
    if (touch.site is not None) + (touch.position_mm is not None) + touch.whole_plate != 1:
        yield f"{key}: give exactly one of site, position_mm and whole_plate = true"
    if touch.site is not None and touch.site not in site_ids:
        yield f"{key}.site: got {touch.site}; plate {plate.name} has {min(site_ids)} to {max(site_ids)}"
    for name, point in (("position_mm", touch.position_mm), ("to_mm", touch.to_mm)):
        if point and not np.all((low_mm <= point) & (point <= high_mm)):
            limits = f"x {low_mm[0]:g} to {high_mm[0]:g}, y {low_mm[1]:g} to {high_mm[1]:g}"
            yield f"{key}.{name}: got {list(point)}; plate {plate.name} reaches over {limits}"
    if touch.to_mm and touch.whole_plate:
        yield f"{key}.to_mm: a touch of the whole plate cannot slide; leave it out"
    if touch.to_mm and not touch.hold_s:
        yield f"{key}.hold_s: got 0; a touch slides during its hold, which must last longer than 0 s"


def _sentence(error: ErrorDetails) -> str:
    path = error["loc"]
    where = ".".join(f"[{key}]" if isinstance(key, int) else key for key in path).replace(".[", "[")
    if error["type"] == "extra_forbidden":
        tables: dict[str, type[BaseModel]] = {
            "shear": Shear,
            "touches": Touch,
            "plate": Physics,
            "faults": FaultPlan,
            "events": FaultEvent,
        }
        above = (tables[key] for key in reversed(path[:-1]) if isinstance(key, str) and key in tables)
        return f"{where}: unknown key; {nearest(str(path[-1]), tuple(next(above, ScenarioFile).model_fields))}"
    return f"{where}: {message_of(error)}"
