"""The configuration that a daemon works by, and what has become of its file since."""

import asyncio
import logging

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.values import Changes, applied, changes, values_in_words
from resonator_daemon.daemon.monitoring.status import ConfigChange, ConfigStatus
from resonator_daemon.daemon.service.config_store import ConfigStore, Loaded
from resonator_daemon.daemon.service.recording_commands import as_json_text

log = logging.getLogger(__name__)


class ConfigInUse:
    """Loads the configuration of a daemon, and again when asked; a file that is bad changes nothing.

    Parameters
    ----------
    store
        Of the file, and of its last good copy.

    Attributes
    ----------
    config
        In use: the file's content at the start, with the keys that were changed live since.

    Raises
    ------
    ConfigurationError
        Neither the file nor a copy can be used.
    """

    def __init__(self, store: ConfigStore) -> None:
        self._store = store
        self._loaded = store.load()
        self._problems = _one_line_each(self._loaded.problems)  # of the file as it is now
        self._waiting: tuple[str, ...] = ()  # keys whose new values need a restart
        self._reloads = 0
        self._changes: tuple[ConfigChange, ...] = ()  # of the last reload
        self.config: Config = self._loaded.config

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
            file=as_json_text(self._store.path),
            in_use=self._loaded.in_use,
            reason_code=self.remark.code if self.remark is not None else None,
            problems=self._problems,
            loaded_t_ns=self._loaded.utc_ns,
            needs_restart=self._waiting,
            reloads=self._reloads,
            changes=self._changes,
        )

    async def reload(self) -> Changes | None:
        """Read the file again and take what needs no restart; None, and the log, where it cannot be used."""
        try:
            loaded: Loaded = await asyncio.to_thread(self._store.reload)
        except ConfigurationError as error:
            self._reloads, self._changes = self._reloads + 1, ()
            self._problems = _one_line_each(error.messages)
            for message in error.messages:
                log.error("%s", message)
            log.error("the configuration cannot be used; all goes on as before")
            return None
        found = changes(self.config, loaded.config)
        before, after = _texts(self.config), _texts(loaded.config)
        self._reloads += 1
        self._changes = tuple(
            ConfigChange(key=key, old=before[key], new=after[key], applied=key in found.live)
            for key in (*found.live, *found.restart)
        )
        self.config = applied(self.config, loaded.config)
        self._loaded, self._problems, self._waiting = loaded, (), found.restart
        log.info("configuration read again: %s", found)
        return found


def _texts(config: Config) -> dict[str, str]:
    return {key: as_json_text(text) for key, text in values_in_words(config).items()}


def _one_line_each(problems: tuple[str, ...]) -> tuple[str, ...]:
    """Return problems as messages can carry them: they name files, and names of files may be no text."""
    return tuple(as_json_text(problem) for problem in problems)
