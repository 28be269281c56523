"""Scenarios: who touches the plate where, when and how hard, read from a TOML file."""

import tomllib
from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from resonator_daemon.plate import Plate

FloatArray = npt.NDArray[np.float64]

FRICTION_COEFFICIENT = 0.5  # of every touch

_SHIPPED = Path(__file__).with_name("scenarios")
_ON_SITE_M = 1e-9
_SHORTEST_RAMP_S = 1e-9  # stands for an instant

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Shear(_Table):
    """Tangential force during the hold: from 0 to peak_ratio of what friction can carry, and back."""

    peak_ratio: Annotated[float, Field(gt=0, le=1, strict=True)]
    direction_deg: Finite = 0.0


class Touch(_Table):
    """One press on a site or a place: force rises, holds and falls; ramps are raised cosines."""

    start_s: NotNegative
    site: Annotated[int, Field(strict=True)] | None = None
    position_mm: tuple[Finite, Finite] | None = None
    force_newton: Positive
    rise_s: NotNegative = 0.1
    hold_s: NotNegative = 0.8
    fall_s: NotNegative = 0.1
    shear: Shear | None = None

    @property
    def duration_s(self) -> float:
        return self.rise_s + self.hold_s + self.fall_s


class ScenarioFile(_Table):
    """A scenario file: its touches, repeated every period_s where that is given."""

    touches: tuple[Touch, ...] = ()
    period_s: Positive | None = None


class Pressing(NamedTuple):
    """What every touch of a scenario does at n moments."""

    ids: npt.NDArray[np.int64]  # (n, touches): a number of its own for each repetition of a touch, from 1
    force_newton: FloatArray  # (n, touches, 3): x, y, z; z presses


class Scenario:
    """The touches of a scenario on one plate; time counts from the first frame."""

    def __init__(self, touches: tuple[Touch, ...], period_s: float | None, plate: Plate) -> None:
        site_index_by_id = {int(site_id): index for index, site_id in enumerate(plate.site_ids)}
        self.positions_m = np.array(
            [
                plate.site_positions_m[site_index_by_id[touch.site]]
                if touch.site is not None
                else np.multiply(touch.position_mm or (), 1e-3)
                for touch in touches
            ]
        ).reshape(-1, 2)
        self.site_ids = tuple(_site_at(position, plate) for position in self.positions_m)
        self.peak_newton = np.array([touch.force_newton for touch in touches])
        self._period_s = period_s
        self._start_s = np.array([touch.start_s for touch in touches])
        self._rise_s = np.array([max(touch.rise_s, _SHORTEST_RAMP_S) for touch in touches])
        self._hold_s = np.array([max(touch.hold_s, _SHORTEST_RAMP_S) for touch in touches])
        self._fall_s = np.array([max(touch.fall_s, _SHORTEST_RAMP_S) for touch in touches])
        self._shear_peak = np.array([touch.shear.peak_ratio if touch.shear else 0.0 for touch in touches])
        directions = np.radians([touch.shear.direction_deg if touch.shear else 0.0 for touch in touches])
        self._shear_direction = np.stack([np.cos(directions), np.sin(directions)], axis=-1)

    def at(self, times_s: FloatArray) -> Pressing:
        """Return what every touch does at times (n,)."""
        since_s = times_s[:, np.newaxis] - self._start_s
        round_number = np.zeros_like(since_s)
        if self._period_s is not None:
            round_number = np.maximum(np.floor(since_s / self._period_s), 0.0)
            since_s = since_s - round_number * self._period_s
        held_s = since_s - self._rise_s
        normal = (
            self.peak_newton * _ramp(since_s / self._rise_s) * (1.0 - _ramp((held_s - self._hold_s) / self._fall_s))
        )
        # A ramp up and down again over the hold is the square of a sine.
        ratio = self._shear_peak * np.sin(np.pi * np.clip(held_s / self._hold_s, 0.0, 1.0)) ** 2
        tangential = ratio * FRICTION_COEFFICIENT * normal
        force = np.concatenate([tangential[..., np.newaxis] * self._shear_direction, normal[..., np.newaxis]], axis=-1)
        number = np.arange(1, len(self.positions_m) + 1)
        return Pressing(number + round_number.astype(np.int64) * len(self.positions_m), force)


def shipped_scenarios() -> tuple[str, ...]:
    """Return the names of the scenarios that come with the emulator."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


def default_scenario(plate: Plate) -> str:
    """Return the name of the scenario that shows what a plate can do."""
    return "touches" if plate.counter.kind == "single-tone" else "press-and-shear"


def load_scenario(name_or_path: str, plate: Plate) -> Scenario:
    """Load a shipped scenario by its name, or a scenario file by its path.

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
        near = _nearest(name_or_path, shipped)
        raise ValueError(f"no shipped scenario and no file is named {name_or_path!r}; {near}") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # not TOML, or not UTF-8
        raise ValueError(f"{path}: not TOML: {error}") from None
    try:
        file = ScenarioFile.model_validate(content)
    except ValidationError as error:
        raise ValueError("\n".join(f"{path}: {_sentence(finding)}" for finding in error.errors())) from None
    if findings := list(_findings(file, plate)):
        raise ValueError("\n".join(f"{path}: {finding}" for finding in findings))
    return Scenario(file.touches, file.period_s, plate)


def _ramp(progress: FloatArray) -> FloatArray:
    """Rise from 0 to 1 as a raised cosine while progress goes from 0 to 1."""
    ramp: FloatArray = 0.5 - 0.5 * np.cos(np.pi * np.clip(progress, 0.0, 1.0))
    return ramp


def _site_at(position_m: FloatArray, plate: Plate) -> int | None:
    distance_m = np.hypot(*(plate.site_positions_m - position_m).T)
    nearest = int(distance_m.argmin())
    return int(plate.site_ids[nearest]) if distance_m[nearest] < _ON_SITE_M else None


def _findings(file: ScenarioFile, plate: Plate) -> Iterator[str]:
    low_mm, high_mm = np.min(plate.outline_mm, axis=0), np.max(plate.outline_mm, axis=0)
    site_ids = plate.site_ids.tolist()
    for index, touch in enumerate(file.touches):
        key = f"touches[{index}]"
        if (touch.site is None) == (touch.position_mm is None):
            yield f"{key}: give either site or position_mm"
        if touch.site is not None and touch.site not in site_ids:
            yield f"{key}.site: got {touch.site}; plate {plate.name} has {min(site_ids)} to {max(site_ids)}"
        if touch.position_mm and not np.all((low_mm <= touch.position_mm) & (touch.position_mm <= high_mm)):
            limits = f"x {low_mm[0]:g} to {high_mm[0]:g}, y {low_mm[1]:g} to {high_mm[1]:g}"
            yield f"{key}.position_mm: got {list(touch.position_mm)}; plate {plate.name} reaches over {limits}"
        if file.period_s is not None and touch.duration_s > file.period_s:
            yield f"{key}: lasts {touch.duration_s:g} s; at most one period_s, {file.period_s:g} s"


def _sentence(error: ErrorDetails) -> str:
    path = error["loc"]
    where = ".".join(f"[{key}]" if isinstance(key, int) else key for key in path).replace(".[", "[")
    if error["type"] != "extra_forbidden":
        value = "" if error["type"] == "missing" else f"got {error['input']!r}; "
        return f"{where}: {value}{error['msg'][0].lower()}{error['msg'][1:]}"
    tables: dict[str, type[_Table]] = {"shear": Shear, "touches": Touch}
    table = next((tables[key] for key in reversed(path[:-1]) if isinstance(key, str) and key in tables), ScenarioFile)
    return f"{where}: unknown key; {_nearest(str(path[-1]), tuple(table.model_fields))}"


def _nearest(word: str, allowed: tuple[str, ...]) -> str:
    near = get_close_matches(word, allowed, n=1)
    return f"did you mean {near[0]}?" if near else f"allowed: {', '.join(allowed)}"
