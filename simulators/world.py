"""A plate that differs from its file: what an emulator has in place of what the daemon assumes."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import ValidationError

from resonator_daemon.base.plate import Plate
from simulators.findings import nearest
from simulators.physics import Physics


@dataclass
class World:
    """A plate as it is, and what no plate file states.

    Parameters
    ----------
    plate
    positions_mm
        Standard deviation of each coordinate of a skin's sites.
    common_walk
        Random walk that all frequencies of a skin share: relative standard deviation after 1 s.
    oscillator
        Factor of the noise of the oscillators of force sites.
    layer
        Thickness in mm of a skin that is bonded to a rigid plate; infinite: a half-space.
    adhesion
        Share s of the load (JKR): the pressure is (1 + s) times that of a ball, less s times that of a flat punch.
    flat
        Whether a flat punch touches a skin, in place of a ball.
    dead
        Indices of signals and sites whose tones no load shifts.
    """

    plate: Plate
    positions_mm: float = 0.0
    common_walk: float = 0.0
    oscillator: float = 1.0
    layer: float = math.inf
    adhesion: float = 0.0
    flat: bool = False
    dead: list[tuple[int, int]] = field(default_factory=list)

    def with_oscillator_noise(self, physics: Physics) -> Physics:
        """Return imperfections of a plate with the oscillators' noise of this world."""
        noise = ("white_fm", "flicker_fm", "random_walk_fm")
        return physics.model_copy(update={key: self.oscillator * getattr(physics, key) for key in noise})


Value = float | str
Change = Callable[[World, dict[str, Any], Value], None]
"""Applies the value of a key to a world, or to the table of its plate; ValueError if it cannot be used."""


_FACTOR: Final = 0.2, 5.0  # range of every factor; below it, tables of the emulated skin take minutes


def _number(value: Value, low: float = -math.inf, high: float = math.inf) -> float:
    if isinstance(value, str | bool) or not (math.isfinite(value) and low <= value <= high):
        raise ValueError(value)
    return float(value)


def _scale_skin(key: str) -> Change:
    def change(_: World, table: dict[str, Any], value: Value) -> None:
        table["skin"][key] *= _number(value, *_FACTOR)

    return change


def _set_poisson_ratio(_: World, table: dict[str, Any], value: Value) -> None:
    table["skin"]["poisson_ratio"] = _number(value)


def _scale_sensitivities(_: World, table: dict[str, Any], value: Value) -> None:
    for tone in _tones(table):
        tone["sensitivity"] = [_number(value, *_FACTOR) * each for each in tone["sensitivity"]]


def _shift_frequencies(_: World, table: dict[str, Any], value: Value) -> None:
    for tone in _tones(table):
        tone["f0_hz"] = [(1.0 + _number(value, -1e-3, 1e-3)) * each for each in tone["f0_hz"]]


def _tones(table: dict[str, Any]) -> list[dict[str, Any]]:
    if "grid" in table:
        return [table["grid"]]  # whose frequencies are the board's
    return [tone for site in table["sites"] for tone in site["tones"]]


def _set(key: str, high: float = math.inf) -> Change:
    def change(world: World, _: dict[str, Any], value: Value) -> None:
        setattr(world, key, _number(value, 0.0, high))

    return change


def _set_shape(world: World, _: dict[str, Any], value: Value) -> None:
    world.flat = ("ball", "punch").index(str(value)) == 1


def _add_dead(world: World, _table: dict[str, Any], value: Value) -> None:
    signals, sites = world.plate.signals, [str(site) for site in world.plate.site_ids]
    for name in str(value).split("+"):
        signal, _, site = name.partition("@")
        world.dead.append((signals.index(signal), sites.index(site)))


class _Key(NamedTuple):
    plates: str | None  # that have it; None: all
    example: Value
    meaning: str
    change: Change


_SKIN, _SITES = "a skin", "force sites"
_KEYS: Final[dict[str, _Key]] = {
    "depth": _Key(_SKIN, 1.05, "a factor of the skin's depth, 0.2 to 5", _scale_skin("depth_mm")),
    "modulus": _Key(_SKIN, 1.05, "a factor of the skin's modulus, 0.2 to 5", _scale_skin("youngs_modulus_pascal")),
    "poisson": _Key(_SKIN, 0.45, "Poisson's ratio of the skin", _set_poisson_ratio),
    "layer": _Key(_SKIN, 10.0, "the thickness in mm, above its depth, of a skin on a rigid plate", _set("layer")),
    "adhesion": _Key(_SKIN, 0.1, "adhesion (JKR) as a share of the load, 0 to 1", _set("adhesion", 1.0)),
    "shape": _Key(_SKIN, "punch", "ball or punch, which touches the skin", _set_shape),
    "gain": _Key(None, 1.05, "a factor of all sensitivities, 0.2 to 5", _scale_sensitivities),
    "k": _Key(None, 1.05, "a factor of all sensitivities, 0.2 to 5", _scale_sensitivities),
    "f0": _Key(_SITES, 2e-6, "a relative shift of all frequencies, -1e-3 to 1e-3", _shift_frequencies),
    "positions_mm": _Key(_SKIN, 0.1, "a standard deviation of the coordinates of sites", _set("positions_mm")),
    "common_walk": _Key(_SKIN, 1e-8, "a relative random walk of all frequencies in 1 s", _set("common_walk")),
    "oscillator": _Key(_SITES, 3.0, "a factor of the noise of the oscillators", _set("oscillator")),
    "dead": _Key(_SKIN, "p_n@417", "signals that do not react to load, as SIGNAL@SITE, joined by +", _add_dead),
}


def world_schema() -> dict[str, Any]:
    """Return the JSON Schema of a table of keys."""
    properties = {
        key: {"type": "string" if isinstance(known.example, str) else "number", "description": known.meaning}
        for key, known in _KEYS.items()
    }
    return {"type": "object", "additionalProperties": False, "properties": properties}


def with_world(plate: Plate, spec: str = "", table: Mapping[str, Value] = MappingProxyType({})) -> World:
    """Return a plate as it is in an emulator's world.

    Parameters
    ----------
    plate
        As its file has it.
    spec
        Keys of a command line, such as `depth=1.05,dead=p_n@417`.
    table
        Keys of a scenario; those of the command line have precedence.

    Raises
    ------
    ValueError
        Unknown key, a key twice, or a value that cannot be used.
    """
    entries = [entry.partition("=") for entry in spec.split(",") if entry]
    if any(not key for key, *_ in entries):
        raise ValueError(f"world: got {spec!r}; must be KEY=VALUE, joined by commas, such as depth=1.05")
    if len({key for key, *_ in entries}) < len(entries):
        raise ValueError(f"world: {spec!r} has a key twice; give it once")
    given = {**table, **{key: _value(text) for key, _, text in entries}}
    world = World(plate)
    if not given:
        return world
    content = plate.model_dump(mode="json", exclude_unset=True)
    for key in ("date", "expiry"):
        if (day := getattr(plate.calibration, key)) is not None:
            content["calibration"][key] = day  # no text
    kind = _SITES if plate.skin is None else _SKIN
    for key, value in given.items():
        if key not in _KEYS:
            raise ValueError(f"world.{key}: unknown key; {nearest(key, tuple(_KEYS))}")
        plates, example, meaning, change = _KEYS[key]
        if plates not in (None, kind):
            raise ValueError(f"world.{key}: only for plates with {plates}, and {plate.name} has none; leave it out")
        try:
            change(world, content, value)
        except (OverflowError, TypeError, ValueError):
            such = f"{key} = {json.dumps(example)}" if key in table else f"{key}={example}"
            raise ValueError(f"world.{key}: got {value!r}; must be {meaning}, such as {such}") from None
    try:
        world.plate = Plate.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise ValueError(f"world: {place}: {first['msg']}; change {', '.join(given)}") from None
    if world.plate.skin is not None and world.layer <= (depth_mm := world.plate.skin.depth_mm):
        raise ValueError(f"world.layer: got {world.layer:g}; must be above the depth of the sites, {depth_mm:g} mm")
    if world.flat and world.adhesion:
        raise ValueError("world.adhesion: changes the pressure of a ball alone; leave out adhesion or the shape punch")
    width_mm = 1e3 * float(np.ptp(world.plate.outline_m, axis=0).min())
    if world.positions_mm > width_mm / 10:
        raise ValueError(
            f"world.positions_mm: got {world.positions_mm:g}, which moves sites off the plate of {width_mm:g} mm; "
            f"use at most {width_mm / 10:g}"
        )
    return world


def _value(text: str) -> Value:
    try:
        return float(text)
    except ValueError:
        return text
