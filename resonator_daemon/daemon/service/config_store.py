"""The configuration in use, and its last good copy, on which a daemon runs if its file is bad at the start."""

import asyncio
import hashlib
import logging
import os
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, Field, ValidationError

from resonator_daemon.base.errors import ConfigurationError, meaning_of
from resonator_daemon.base.host.files import replace_file
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.base.toml import TomlFile, named, parse_toml, read_toml
from resonator_daemon.board.config import Config, config_from, load_config
from resonator_daemon.board.config.values import Changes, applied, changes, load_plate_text, plate_text, values_in_words
from resonator_daemon.daemon.monitoring.status import ConfigChange, ConfigStatus
from resonator_daemon.daemon.service.recordings import as_json_text
from resonator_daemon.measure.sensors.base import sensor_of

log = logging.getLogger(__name__)


class Loaded(NamedTuple):
    """A configuration to run on."""

    config: Config
    in_use: Literal["file", "last_good"]
    problems: tuple[str, ...]  # of the file, which is then not in use
    sha256: str  # of the text that the configuration was read from
    utc_ns: int  # when it was read


class _Copy(BaseModel):
    """What is kept of a good configuration, in one file, so that its parts are of the same time."""

    format: Literal[1] = 1
    file: str
    saved_utc_ns: Annotated[int, Field(ge=0, lt=1 << 63)]
    config: str
    plate: str  # as `plate_text` has it


class ConfigStore:
    """Loads the configuration of a daemon, and again when asked; keeps a copy of it, with its plate, while it is good.

    A file that is bad changes nothing while the daemon runs. Password, certificates and keys stay where they are: a
    copy names them as the file does. The copy can be read by the daemon's user alone, since the address of a broker may
    have a password in it.

    Parameters
    ----------
    path
        The configuration file.
    directory
        Where copies are kept, as `state_directory() / "last-good"`; made where it is missing.

    Attributes
    ----------
    config
        In use since `load`: the file's content then, with the keys that were changed live since.
    """

    config: Config
    _loaded: Loaded

    def __init__(self, path: Path, directory: Path) -> None:
        self.path = path.absolute()  # messages with it are read by programs that run elsewhere
        normal = os.path.abspath(path)
        self._copy = directory / f"{path.stem}-{hashlib.sha256(os.fsencode(normal)).hexdigest()[:16]}.json"
        self._reported: str | None = None  # why no copy can be kept
        self._problems: tuple[str, ...] = ()  # of the file as it is now
        self._waiting: tuple[str, ...] = ()  # keys whose new values need a restart
        self._reloads = 0
        self._changes: tuple[ConfigChange, ...] = ()  # of the last reload

    def load(self) -> Loaded:
        """Load the file, else the last good copy, which is logged.

        A file that is not there is not replaced: it was removed so that it is not used.

        Raises
        ------
        ConfigurationError
            The file cannot be used, and no copy can; what is wrong with the file.
        """
        try:
            self._loaded = self._load_file()
        except ConfigurationError as error:
            if not os.path.lexists(self.path):
                raise
            self._loaded = self._last_good(error)
        for problem in self._loaded.problems:
            log.error("%s", problem)
        self.config, self._problems = self._loaded.config, _one_line_each(self._loaded.problems)
        return self._loaded

    async def reload(self) -> Changes | None:
        """Read the file again and apply what needs no restart; None, and the log, where it cannot be used."""
        self._reloads += 1
        try:
            loaded = await asyncio.to_thread(self._load_file)
        except ConfigurationError as error:
            self._changes, self._problems = (), _one_line_each(error.messages)
            for message in error.messages:
                log.error("%s", message)
            log.error("the configuration cannot be used; all goes on as before")
            return None
        found = changes(self.config, loaded.config)
        before, after = values_in_words(self.config), values_in_words(loaded.config)
        self._changes = tuple(
            ConfigChange(
                key=key, old=as_json_text(before[key]), new=as_json_text(after[key]), applied=key in found.live
            )
            for key in (*found.live, *found.restart)
        )
        self.config = applied(self.config, loaded.config)
        self._loaded, self._problems, self._waiting = loaded, (), found.restart
        log.info("configuration read again: %s", found)
        return found

    @property
    def sha256(self) -> str:
        """Of the text that the configuration was read from."""
        return self._loaded.sha256

    @property
    def remark(self) -> Reason | None:
        """What is wrong with the file or waits for a restart; None if the file is in use as it is."""
        if self._problems:
            last_good = self._loaded.in_use == "last_good"
            on = "on the last good configuration" if last_good else "its changed configuration cannot be used"
            more = f", and {len(self._problems) - 1} more" if len(self._problems) > 1 else ""
            return Reason(ReasonCode.BAD_CONFIGURATION, f"{on}: {self._problems[0]}{more}")
        if self._waiting:
            return Reason(ReasonCode.RESTART_NEEDED, f"restart for changed {', '.join(self._waiting)}")
        return None

    @property
    def status(self) -> ConfigStatus:
        return ConfigStatus(
            file=as_json_text(self.path),
            in_use=self._loaded.in_use,
            reason_code=self.remark.code if self.remark is not None else None,
            problems=self._problems,
            loaded_t_ns=self._loaded.utc_ns,
            needs_restart=self._waiting,
            reloads=self._reloads,
            changes=self._changes,
        )

    def _load_file(self) -> Loaded:
        """Load the file, and keep a copy of it; blocks for up to a second, while it is computed and on the disk."""
        file = read_toml(self.path)
        config = _checked(config_from(file, self.path.parent), self.path)
        self._keep(file, config)
        return Loaded(config, "file", (), _sha256(file.text), time.time_ns())

    def _last_good(self, refused: ConfigurationError) -> Loaded:
        try:
            copy = self._read()
        except FileNotFoundError:
            raise refused from None
        except (OSError, ValidationError) as error:
            raise ConfigurationError(
                *refused.messages, f"{named(self._copy)}: {_reason(error)}; no last good copy"
            ) from None
        try:
            config = _checked(self._config_of(copy), self._copy)
        except ConfigurationError as error:
            also = (f"the last good copy cannot be used either: {message}" for message in error.messages)
            raise ConfigurationError(*refused.messages, *also) from None
        saved = f"{datetime.fromtimestamp(copy.saved_utc_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S}"
        log.error("%s cannot be used; running on the last good copy, of %s UTC", named(self.path), saved)
        return Loaded(config, "last_good", refused.messages, _sha256(copy.config), time.time_ns())

    def _config_of(self, copy: _Copy) -> Config:
        plate = load_plate_text(copy.plate, self._copy / "plate.toml")
        file = parse_toml(copy.config, self._copy / "config.toml")
        content = file.content | {"plate": plate}
        return config_from(TomlFile(file.path, file.text, content), self.path.parent)

    def _keep(self, file: TomlFile, config: Config) -> None:
        """Write the copy, unless it is there; a failure is logged once and stops nothing."""
        name = os.fsencode(self.path).decode(errors="replace")
        copy = _Copy(file=name, saved_utc_ns=time.time_ns(), config=file.text, plate=plate_text(config.plate))
        try:
            if not self._kept(copy):
                replace_file(self._copy, copy.model_dump_json().encode(), 0o600)
        except OSError as error:
            if (reason := _reason(error)) != self._reported:
                log.warning("no copy of this configuration is kept for the day it is bad: %s: %s", self._copy, reason)
            self._reported = reason
        else:
            self._reported = None

    def _read(self) -> _Copy:
        return _Copy.model_validate_json(self._copy.read_bytes())

    def _kept(self, copy: _Copy) -> bool:
        try:
            present = self._read()
        except (FileNotFoundError, ValidationError):
            return False
        return (present.config, present.plate) == (copy.config, copy.plate)


def load_checked(path: Path) -> Config:
    """Load a configuration, and check that its sensor can be set up.

    Raises
    ------
    ConfigurationError
        Every finding.
    """
    return _checked(load_config(path), path)


def _checked(config: Config, path: Path) -> Config:
    if problems := sensor_of(config.plate, config.measurement, config.decoding).problems:
        raise ConfigurationError(*(f"{named(path)}: plate: {sentence}" for sentence in problems))
    return config


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _reason(error: OSError | ValidationError) -> str:
    return meaning_of(error) if isinstance(error, OSError) else "is damaged"


def _one_line_each(problems: tuple[str, ...]) -> tuple[str, ...]:
    """Return problems as messages can carry them: they name files, and names of files may be no text."""
    return tuple(map(as_json_text, problems))
