"""Differences between two configurations: applied by a running daemon, or only after a restart."""

from collections.abc import Iterator
from typing import Final, NamedTuple

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.toml import Table, shown
from resonator_daemon.board.config.board import Config
from resonator_daemon.board.links.target import LinkTarget

LIVE: Final = ("measurement", "commands", "recording")
"""Tables whose keys a running daemon applies; windows of a new plate wait for that plate."""


class Changes(NamedTuple):
    """Return paths of the keys whose values differ, as `measurement.window_ms`, in the order of the models."""

    live: tuple[str, ...]
    restart: tuple[str, ...]

    def __str__(self) -> str:
        parts = [f"taken: {', '.join(self.live)}"] if self.live else []
        parts += [f"restart for {', '.join(self.restart)}"] if self.restart else []
        return "; ".join(parts) or "nothing changed"


def takes_live(key: str) -> bool:
    """Return whether a running daemon applies a key of this path; `changes` has the exceptions."""
    return key.partition(".")[0] in LIVE


def changes(old: Config, new: Config) -> Changes:
    """Return the differences between the configuration in use and a new one.

    Windows are checked against the frames of their own plate: while the plate waits for a restart, they do.
    """
    before, after = dict(_values(old)), dict(_values(new))
    changed = [key for key, value in after.items() if before[key] != value]
    waits = {"measurement"} if "plate" in changed else set()
    live = [key for key in changed if takes_live(key) and key.partition(".")[0] not in waits]
    return Changes(tuple(live), tuple(key for key in changed if key not in live))


def values_in_words(config: Config) -> dict[str, str]:
    """Return each value by the path of its key, without passwords; of a plate its name and calibration."""
    return {key: _in_words(value) for key, value in _values(config)}


def _in_words(value: object) -> str:
    match value:
        case {"name": name, "calibration": {"id": calibration}}:
            return f"{name}, calibration {calibration or 'none'}"
        case None | bool() | int() | float() | str() | tuple() | list():
            return shown(value)
        case LinkTarget():
            return shown(str(value))
        case _:
            return "a file"  # of a password, a certificate or a key


def applied(old: Config, new: Config) -> Config:
    """Return the configuration in use with those values of the new one that need no restart."""
    tables = {key.partition(".")[0] for key in changes(old, new).live}
    return old.model_copy(update={table: getattr(new, table) for table in tables})


def _values(table: Table, path: str = "") -> Iterator[tuple[str, object]]:
    for name in type(table).model_fields:
        value = getattr(table, name)
        if isinstance(value, Plate):
            yield path + name, value.model_dump()
        elif isinstance(value, Table):
            yield from _values(value, f"{path}{name}.")
        else:
            yield path + name, value
