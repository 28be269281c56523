"""What a recording is to be played with: what it carries itself, or a configuration instead of that."""

import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeVar

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.host.text import printable
from resonator_daemon.base.plate import Plate
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.values import Settings, config_of, load_plate_text, load_settings_text
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.recording.reader import PLATE_FILE, SETTINGS_FILE, Recording, open_recording
from resonator_daemon.tools.replay.recorded_pipeline import RecordingReplay

_Loaded = TypeVar("_Loaded")

UNKNOWN_BOOT_ID: Final = "0" * 8  # of a recording that no daemon made


@contextmanager
def open_replay(
    path: Path, config: Config | None = None, daemon_boot_id: str | None = None
) -> Iterator[RecordingReplay]:
    """Open a recording to be played with what it carries, or with another configuration of the same plate.

    Messages bear the given boot id of a daemon, or else the recorded one.

    Raises
    ------
    LinkUnavailableError
        No such file, no recording, of another format, or of a plate whose frames are others.
    ConfigurationError
        What it carries is damaged or does not suit this version, or a configuration is missing and it carries none.
    """
    with open_recording(str(path), config.plate if config else None) as recording:
        boot_id = daemon_boot_id or recording.header.get("daemon_boot_id", UNKNOWN_BOOT_ID)
        yield RecordingReplay(recording, config or recorded_config(recording), boot_id)


def recorded_config(recording: Recording, plate: Plate | None = None, settings: Settings | None = None) -> Config:
    """Return the configuration that a recording carries, as far as it matters to its messages.

    A plate and settings that are given replace those of the recording.
    """
    path = Path(recording.path)
    plate_text, settings_text = recording.plate_text, recording.settings_text
    if (plate is None and plate_text is None) or (settings is None and settings_text is None):
        if recording.damaged_attachments:
            raise _damaged(path, recording.damaged_attachments[0])
        raise ConfigurationError(f"{path} does not carry its plate file and settings; give --config FILE")
    try:
        link = parse_link(recording.header.get("link"))
    except ValueError as error:
        raise ConfigurationError(f"{path}: link: {error}") from error
    plate = plate or _loaded(load_plate_text, plate_text or "", path, PLATE_FILE)
    settings = settings or _loaded(load_settings_text, settings_text or "", path, SETTINGS_FILE)
    return config_of(plate, settings, link, name=recording.header.get("name"))


def _loaded(load: Callable[[str, Path], _Loaded], text: str, path: Path, name: str) -> _Loaded:
    """Load a text of the recording; errors add that the file itself cannot be edited."""
    try:
        return load(text, path / name)
    except ConfigurationError as error:
        try:
            tomllib.loads(text)
        except (ValueError, RecursionError):
            raise _damaged(path, name) from error
        raise ConfigurationError(*error.messages, f"{path}: its {name} cannot be used; give --config FILE") from error


def _damaged(path: Path, name: str) -> ConfigurationError:
    return ConfigurationError(
        f"{path}: its attachment {printable(name)} is damaged; give plate and settings with --config FILE"
    )
