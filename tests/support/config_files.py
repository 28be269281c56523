"""Configuration files of tests: what they are read as, and what is said of those that are refused."""

from collections.abc import Callable
from pathlib import Path

import pytest

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.board.config import Config, load_config


def loaded(folder: Path, text: str) -> Config:
    path = folder / "board.toml"
    path.write_text(text)
    return load_config(path)


def refusals(folder: Path, text: str) -> list[str]:
    return findings(lambda _: loaded(folder, text), folder / "board.toml")


def findings(load: Callable[[Path], object], path: Path) -> list[str]:
    """Return the messages about a file that is refused, each one line, without the path that it begins with."""
    with pytest.raises(ConfigurationError) as caught:
        load(path)
    assert all(message.startswith(f"{path}:") and "\n" not in message for message in caught.value.messages)
    return [message.removeprefix(f"{path}:") for message in caught.value.messages]
