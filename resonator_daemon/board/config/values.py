"""Values of a configuration: as TOML in a recording and back, in words, and compared with those of another."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import tomlkit

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.toml import Table, TomlFile, load_model, parse_toml, shown
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.config.tables import Decoding, Measurement
from resonator_daemon.board.links.target import LinkTarget


class Settings(Table):
    """Settings that, together with the plate, determine the results from a link's bytes."""

    measurement: Measurement
    decoding: Decoding


def plate_text(plate: Plate) -> str:
    """Return the text of a plate file with all values of this plate, defaults included, without comments.

    Later versions may have other defaults; such a file still means the same. It takes 0.3 s for 400 scattered sites:
    make it once.
    """
    content = plate.model_dump(exclude_none=True)
    if not plate.sites:
        del content["sites"]  # a file with a [grid] has none, not an empty list
    return tomlkit.dumps(content)


def load_plate_text(text: str, origin: Path | str) -> Plate:
    """Load a plate from the text of a plate file; `origin` names it in messages.

    Raises
    ------
    ConfigurationError
        No TOML, or findings: all of them.
    """
    return load_model(Plate, parse_toml(text, origin))


def settings_text(config: Config) -> str:
    """Return the tables [measurement] and [decoding] of a configuration with all values as TOML."""
    return tomlkit.dumps(config.model_dump(include=set(Settings.model_fields), exclude_none=True))


def load_settings_text(text: str, origin: Path | str) -> Settings:
    """Load the text of `settings_text`; `origin` names it in messages.

    Raises
    ------
    ConfigurationError
        No TOML, or findings: all of them.
    """
    return load_model(Settings, parse_toml(text, origin))


def config_of(
    plate: Plate, settings: Settings, link: LinkTarget, *, name: str | None = None, mqtt: Mqtt | None = None
) -> Config:
    """Return a configuration made of a recording's plate, settings and broker, without a file.

    Raises
    ------
    ConfigurationError
        The parts do not suit each other.
    """
    parts = {"name": name, "plate": plate, "link": link, "mqtt": mqtt or Mqtt(), **dict(settings)}
    return load_model(Config, TomlFile(str(link), "", parts))


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
