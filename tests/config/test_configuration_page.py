"""docs/configuration.md says what the code does."""

import re

import configuration_tables

from resonator_daemon.config.help import config_keys
from resonator_daemon.toml_files.limits import LONGEST_WORD, MAX_DEPTH, MAX_KEYS, MAX_LINES, MAX_NAMES, MAX_VALUES
from resonator_daemon.toml_files.reading import MAX_BYTES

PAGE = configuration_tables.PAGE.read_text()


def test_example_and_keys_are_those_of_the_models() -> None:
    assert configuration_tables.with_tables(PAGE) == PAGE, "python tests/configuration_tables.py writes them anew"
    assert len(re.findall(r"^\| `", PAGE, re.MULTILINE)) == len(config_keys())


def test_the_limit_it_names_is_the_limit() -> None:
    assert "longer than 10 MB" in PAGE
    assert MAX_BYTES == 10e6
    assert (MAX_DEPTH, LONGEST_WORD) == (8, 1000)
    limits = {"keys": MAX_KEYS, "other values": MAX_VALUES, "lines": MAX_LINES, "names in headers": MAX_NAMES}
    for what, limit in limits.items():
        assert f"{limit:,} {what}".replace(",", " ") in PAGE


def test_every_link_of_the_page_leads_somewhere() -> None:
    targets = re.findall(r"\]\(((?!http)[^)#]+)", PAGE)
    assert targets
    assert all((configuration_tables.PAGE.parent / target).exists() for target in targets)
