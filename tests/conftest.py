"""What all tests share: places of their own, processes that can be interrupted, and brokers."""

import itertools
import logging
import os
import signal
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from brokers import Amqtt, Mosquitto
from hypothesis import settings


def pytest_configure() -> None:
    """Processes that tests start can be interrupted, though a shell or nohup ignores signals, and start fast."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    settings.register_profile("any speed", deadline=None)
    settings.load_profile("any speed")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


@pytest.fixture(scope="session", autouse=True)
def _no_cache_at_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Set-ups that the daemon keeps go to a temporary directory, those of child processes too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        for name in ("CACHE_DIRECTORY", "STATE_DIRECTORY", "RUNTIME_DIRECTORY"):
            patch.delenv(name, raising=False)
        yield


@pytest.fixture(scope="session")
def _homes(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Iterator[int]]:
    """A directory with a short name, since paths of sockets have at most 107 bytes, and numbers of tests."""
    return tmp_path_factory.mktemp("h"), itertools.count()


@pytest.fixture(autouse=True)
def _nothing_at_home(_homes: tuple[Path, Iterator[int]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Spools, recordings and sockets of daemons go to directories of each test's own."""
    home = _homes[0] / str(next(_homes[1]))
    home.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(home / "state"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(home))


@pytest.fixture(autouse=True)
def _logging_as_before() -> Iterator[None]:
    """The level a verb sets for its process ends with the test; what loggers are set to otherwise stays as it was."""
    before = _own_loggers()
    yield
    logging.getLogger().setLevel(_ROOT_LEVEL)  # also after a set-up of a module, which is older than this one
    after = _own_loggers()
    assert {name: after[name] for name in before} == before


_ROOT_LEVEL = logging.getLogger().level


def _own_loggers() -> dict[str, tuple[object, ...]]:
    loggers = [log for log in logging.Logger.manager.loggerDict.values() if isinstance(log, logging.Logger)]
    return {
        log.name: (log.level, log.propagate, log.disabled, tuple(log.handlers))
        for log in loggers
        if log.name.startswith("resonator_daemon")
    }


@pytest.fixture
async def mosquitto(tmp_path: Path) -> AsyncIterator[Mosquitto]:
    """Mosquitto, running; speaks MQTT 5."""
    async with Mosquitto(tmp_path) as broker:
        yield broker


@pytest.fixture
async def amqtt() -> AsyncIterator[Amqtt]:
    """The embedded broker, running; speaks MQTT 3.1.1 only."""
    async with Amqtt() as broker:
        yield broker


@pytest.fixture(params=["mosquitto", "amqtt"])
def broker(request: pytest.FixtureRequest) -> Mosquitto | Amqtt:
    """Each broker in turn, running."""
    return request.getfixturevalue(request.param)
