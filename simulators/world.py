"""A plate that differs from its file: what an emulator has in place of what the daemon assumes."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from pydantic import ValidationError

from resonator_daemon.base.plate import Plate
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
    dead
        Indices of signals and sites whose tones no load shifts.
    """

    plate: Plate
    positions_mm: float = 0.0
    common_walk: float = 0.0
    oscillator: float = 1.0
    dead: list[tuple[int, int]] = field(default_factory=list)

    def with_oscillator_noise(self, physics: Physics) -> Physics:
        """Return imperfections of a plate with the oscillators' noise of this world."""
        noise = ("white_fm", "flicker_fm", "random_walk_fm")
        return physics.model_copy(update={key: self.oscillator * getattr(physics, key) for key in noise})


Change = Callable[[World, dict[str, Any], str], None]
"""Applies the text of a key to a world, or to the table of its plate; ValueError if it cannot be used."""


def _scale_skin(key: str) -> Change:
    def change(_: World, table: dict[str, Any], text: str) -> None:
        table["skin"][key] *= float(text)

    return change


def _set_poisson_ratio(_: World, table: dict[str, Any], text: str) -> None:
    table["skin"]["poisson_ratio"] = float(text)


def _scale_sensitivities(_: World, table: dict[str, Any], text: str) -> None:
    for tone in _tones(table):
        tone["sensitivity"] = [float(text) * value for value in tone["sensitivity"]]


def _shift_frequencies(_: World, table: dict[str, Any], text: str) -> None:
    for tone in _tones(table):
        tone["f0_hz"] = [(1.0 + float(text)) * value for value in tone["f0_hz"]]


def _tones(table: dict[str, Any]) -> list[dict[str, Any]]:
    if "grid" in table:
        return [table["grid"]]  # whose frequencies are the board's
    return [tone for site in table["sites"] for tone in site["tones"]]


def _set(key: str) -> Change:
    def change(world: World, _: dict[str, Any], text: str) -> None:
        if not 0.0 <= float(text) < math.inf:
            raise ValueError(text)
        setattr(world, key, float(text))

    return change


def _add_dead(world: World, _table: dict[str, Any], text: str) -> None:
    signals, sites = world.plate.signals, [str(site) for site in world.plate.site_ids]
    for name in text.split("+"):
        signal, _, site = name.partition("@")
        world.dead.append((signals.index(signal), sites.index(site)))


_SKIN, _SITES = "skins", "force sites"
_CHANGES: Final[dict[str, tuple[str | None, str, Change]]] = {  # by key: of which plates, an example, what it does
    "depth": (_SKIN, "1.05", _scale_skin("depth_mm")),
    "modulus": (_SKIN, "1.05", _scale_skin("youngs_modulus_pascal")),
    "poisson": (_SKIN, "0.45", _set_poisson_ratio),
    "gain": (None, "1.05", _scale_sensitivities),
    "k": (None, "1.05", _scale_sensitivities),
    "f0": (_SITES, "2e-6", _shift_frequencies),
    "positions_mm": (_SKIN, "0.1", _set("positions_mm")),
    "common_walk": (_SKIN, "1e-8", _set("common_walk")),
    "oscillator": (_SITES, "3", _set("oscillator")),
    "dead": (_SKIN, "p_n@417", _add_dead),
}


def with_world(plate: Plate, spec: str) -> World:
    """Return a plate as it is in an emulator's world, such as `depth=1.05,dead=p_n@417`; ValueError for a mistake."""
    world = World(plate)
    if not spec:
        return world
    table = plate.model_dump(mode="json", exclude_unset=True)
    for key in ("date", "expiry"):
        if (day := getattr(plate.calibration, key)) is not None:
            table["calibration"][key] = day  # no text
    kind = _SITES if plate.skin is None else _SKIN
    entries = [entry.partition("=") for entry in spec.split(",") if entry]
    if len({key for key, *_ in entries}) < len(entries):
        raise ValueError(f"--world: {spec!r} has a key twice")
    for key, _, text in entries:
        if key not in _CHANGES:
            raise ValueError(f"--world: {key!r} is unknown; must be one of: {', '.join(_CHANGES)}")
        of_plates, example, change = _CHANGES[key]
        if of_plates not in (None, kind):
            raise ValueError(f"--world: {key} applies to {of_plates}; {plate.name} has {kind}")
        try:
            change(world, table, text)
        except ValueError:
            raise ValueError(f"--world: '{key}={text}' cannot be used; write it as {key}={example}") from None
    try:
        world.plate = Plate.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise ValueError(f"--world: {spec!r} makes no plate: {place}: {first['msg']}") from None
    return world
