"""A plate that differs from its file: what an emulator has in place of what the daemon assumes."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from pydantic import ValidationError

from resonator_daemon.base.plate import Plate
from simulators.physics import Physics

Change = Callable[[dict[str, Any], float], None]


def _scale_skin(key: str) -> Change:
    def change(table: dict[str, Any], factor: float) -> None:
        table["skin"][key] *= factor

    return change


def _set_poisson_ratio(table: dict[str, Any], value: float) -> None:
    table["skin"]["poisson_ratio"] = value


def _scale_sensitivities(table: dict[str, Any], factor: float) -> None:
    for tone in _tones(table):
        tone["sensitivity"] = [factor * value for value in tone["sensitivity"]]


def _shift_frequencies(table: dict[str, Any], share: float) -> None:
    for tone in _tones(table):
        tone["f0_hz"] = [(1.0 + share) * value for value in tone["f0_hz"]]


def _tones(table: dict[str, Any]) -> list[dict[str, Any]]:
    if "grid" in table:
        return [table["grid"]]  # whose frequencies are the board's
    return [tone for site in table["sites"] for tone in site["tones"]]


_CHANGES: Final[dict[str, tuple[bool | None, Change]]] = {  # by key: whether of skins or force sites alone
    "depth": (True, _scale_skin("depth_mm")),
    "modulus": (True, _scale_skin("youngs_modulus_pascal")),
    "poisson": (True, _set_poisson_ratio),
    "gain": (None, _scale_sensitivities),
    "k": (None, _scale_sensitivities),
    "f0": (False, _shift_frequencies),
}


@dataclass
class World:
    """A plate as it is, and what no plate file states.

    Parameters
    ----------
    plate
    positions_mm
        Standard deviation of each coordinate of a skin's sites.
    common_walk
        Random walk of all frequencies of a skin, relative, by the square root of a second.
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

    def scaled(self, physics: Physics) -> Physics:
        """Return imperfections of a plate with the oscillators' noise of this world."""
        noise = ("white_fm", "flicker_fm", "random_walk_fm")
        return physics.model_copy(update={key: self.oscillator * getattr(physics, key) for key in noise})


_OTHERS: Final = {"positions_mm": True, "common_walk": True, "oscillator": False}  # by key: of skins or force sites


def with_world(plate: Plate, spec: str) -> World:
    """Return a plate as it is in an emulator's world, such as `depth=1.05,dead=p_n@417`; ValueError for a mistake."""
    table = plate.model_dump(mode="json", exclude_unset=True)
    if plate.calibration.expiry is not None:
        table["calibration"]["expiry"] = plate.calibration.expiry  # no text
    world = World(plate)
    for entry in filter(None, spec.split(",")):
        key, _, text = entry.partition("=")
        of_skin = True if key == "dead" else _OTHERS[key] if key in _OTHERS else _CHANGES.get(key, (None,))[0]
        if key not in ("dead", *_OTHERS, *_CHANGES):
            raise ValueError(f"--world: {key!r} is unknown; must be one of: {', '.join((*_CHANGES, *_OTHERS, 'dead'))}")
        if of_skin not in (None, plate.skin is not None):
            raise ValueError(f"--world: {key} is of {'a skin' if of_skin else 'force sites'}; {plate.name} has none")
        if key == "dead":
            world.dead += [_signal_of_site(plate, name) for name in text.split("+")]
            continue
        try:
            value = float(text)
        except ValueError:
            raise ValueError(f"--world: {entry!r} has no number, as {key}=1.05") from None
        if key in _CHANGES:
            _CHANGES[key][1](table, value)
        elif not 0.0 <= value < math.inf:
            raise ValueError(f"--world: {entry!r} must be 0 or above, and finite")
        else:
            setattr(world, key, value)
    try:
        world.plate = Plate.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"--world: {spec!r} makes no plate: {first['loc'][-1]}: {first['msg']}") from None
    return world


def _signal_of_site(plate: Plate, name: str) -> tuple[int, int]:
    """Return the indices of a signal and a site, such as `p_n@417`."""
    signal, _, site = name.partition("@")
    sites = [str(number) for number in plate.site_ids]
    if signal not in plate.signals or site not in sites:
        raise ValueError(
            f"--world: dead={name!r} is no signal of a site, as {plate.signals[0]}@{sites[0]}; signals of "
            f"{plate.name} are {', '.join(plate.signals)}, sites {sites[0]} to {sites[-1]}"
        )
    return plate.signals.index(signal), sites.index(site)
