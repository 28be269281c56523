"""The schema, the explanations and the page of the configuration say of each key what the models check."""

import json
import re
import tomllib
from typing import Any

import configuration_tables
import jsonschema
import pytest

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.board.config import example_config
from resonator_daemon.board.config.help import config_keys, config_schema
from resonator_daemon.commands import main

SCHEMA = config_schema()
MINIMAL = {"plate": "quartz16", "link": "tcp://127.0.0.1:1"}


def says(content: dict[str, Any]) -> list[str]:
    errors = jsonschema.Draft202012Validator(SCHEMA).iter_errors(content)
    return [".".join(map(str, error.absolute_path)) or error.validator for error in errors]


def test_it_is_a_schema_that_takes_the_example() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert says(tomllib.loads(example_config())) == []
    assert says(MINIMAL) == []
    everything: dict[str, Any] = dict(MINIMAL)
    for key in config_keys():
        *tables, name = key.path.split(".")
        table = everything
        for one in tables:
            table = table.setdefault(one, {})
        table[name] = json.loads(key.examples[0])
    assert says(everything) == []


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"nmae": "a"}, "additionalProperties"),
        ({"mqtt": {"urll": ""}}, "mqtt"),
        ({"measurement": {"window_ms": 0}}, "measurement.window_ms"),
        ({"decoding": {"friction_coefficient": "low"}}, "decoding.friction_coefficient"),
        ({"commands": {"allow": ["tear"]}}, "commands.allow.0"),
        ({"plate": {}}, "plate"),
    ],
)
def test_it_refuses_what_the_models_refuse(change: dict[str, Any], where: str) -> None:
    assert says(MINIMAL | change) == [where]


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["config", *arguments]) == ExitCode.DONE
    out, err = capsys.readouterr()
    assert err == ""
    return out


def test_the_verbs_print_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert json.loads(run(capsys, "schema")) == SCHEMA
    assert run(capsys, "schema", "--json").count("\n") == 1
    words = [line.split()[0] for line in run(capsys, "explain", "measurement.window_ms").splitlines()]
    assert words == ["measurement.window_ms:", "type", "default", "range", "example", "reload"]
    assert "restart the daemon" in run(capsys, "explain", "plate")
    assert [line.split()[0] for line in run(capsys, "explain").splitlines()] == [key.path for key in config_keys()]
    said = json.loads(run(capsys, "explain", "--json", "mqtt.prefix"))
    assert said["verb"] == "config explain"
    (key,) = said["keys"]
    assert (key["path"], key["limits"], key["live"]) == ("mqtt.prefix", "at most 200 characters", False)


PAGE = configuration_tables.PAGE.read_text()


def test_example_and_keys_are_those_of_the_models() -> None:
    assert configuration_tables.with_tables(PAGE) == PAGE, "python docs/tables/configuration_tables.py writes them"
    assert len(re.findall(r"^- `[\w.]+` \(", PAGE, re.MULTILINE)) == len(config_keys())
