"""A plate that differs from its file: what an emulator has in place of what the daemon assumes."""

from collections.abc import Callable
from typing import Any, Final

from pydantic import ValidationError

from resonator_daemon.base.plate import Plate

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


def with_world(plate: Plate, spec: str) -> Plate:
    """Return a plate as it is in an emulator's world, such as `depth=1.05,modulus=0.95`; ValueError for another key."""
    table = plate.model_dump(mode="json", exclude_unset=True)
    for entry in filter(None, spec.split(",")):
        key, _, text = entry.partition("=")
        if key not in _CHANGES:
            raise ValueError(f"--world: {key!r} is unknown; must be one of: {', '.join(_CHANGES)}")
        of_skin, change = _CHANGES[key]
        if of_skin not in (None, plate.skin is not None):
            raise ValueError(f"--world: {key} is of {'a skin' if of_skin else 'force sites'}; {plate.name} has none")
        try:
            change(table, float(text))
        except ValueError:
            raise ValueError(f"--world: {entry!r} has no number, as {key}=1.05") from None
    try:
        return Plate.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"--world: {spec!r} makes no plate: {first['loc'][-1]}: {first['msg']}") from None
