"""docs/reference/configuration.md says what the code does."""

import re

import configuration_tables

from resonator_daemon.board.config.help import config_keys

PAGE = configuration_tables.PAGE.read_text()


def test_example_and_keys_are_those_of_the_models() -> None:
    assert configuration_tables.with_tables(PAGE) == PAGE, "python docs/tables/configuration_tables.py writes them"
    assert len(re.findall(r"^- `[\w.]+` \(", PAGE, re.MULTILINE)) == len(config_keys())
