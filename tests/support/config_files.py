"""Configuration files of tests: what they are read as, and what is said of those that are refused."""

from pathlib import Path

import pytest

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.board.config import Config, load_config


def loaded(folder: Path, text: str) -> Config:
    path = folder / "board.toml"
    path.write_text(text)
    return load_config(path)


def refusals(folder: Path, text: str) -> list[str]:
    """Return the messages, each one line, without the path that it begins with."""
    with pytest.raises(ConfigurationError) as caught:
        loaded(folder, text)
    start = f"{folder / 'board.toml'}:"
    assert all(message.startswith(start) and "\n" not in message for message in caught.value.messages)
    return [message.removeprefix(start) for message in caught.value.messages]
