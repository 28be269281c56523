"""Configuration as TOML text in a recording, and back."""

from pathlib import Path

import tomlkit

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.toml import Table, TomlFile, load_model, parse_toml
from resonator_daemon.board.config.board import Config
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


def load_plate_text(text: str, origin: Path) -> Plate:
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


def load_settings_text(text: str, origin: Path) -> Settings:
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
    return load_model(Config, TomlFile(Path(str(link)), "", parts))
