"""The JSON Schema of scenario files: what it says, and that it takes what the emulator takes."""

import tomllib
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from resonator_daemon.base.plate import load_plate
from simulators import scenario_file
from simulators.scenario import load_scenario
from simulators.scenario_schema import scenario_schema

SCHEMA = scenario_schema()
VALIDATOR = Draft202012Validator(SCHEMA)
SHIPPED = sorted(Path(scenario_file.__file__).with_name("scenarios").glob("*.toml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenarios_keep_to_the_schema(path: Path) -> None:
    VALIDATOR.validate(tomllib.loads(path.read_text()))


EVENT = "[[faults.events]]\nat_s = 1\n"
TOUCH = "[[touches]]\nstart_s = 0\nsite = 1\nforce_newton = 1\n"


@pytest.mark.parametrize(
    ("text", "right"),
    [
        (TOUCH, True),
        (f"{TOUCH}to_mm = [1, 2.5]\nkelvin = 300\n", True),
        ("environment_kelvin = 300\n", True),
        ("environment_kelvin = [[0, 300], [1.5, 301.0]]\n", True),
        ("[plate]\nideal = true\nsensitivity_scatter = 0.01\n", True),
        (f"{TOUCH}to_mm = [1]\n", False),
        (f"{TOUCH}shear = {{ direction_deg = 3 }}\n", False),
        ("[[touches]]\nsite = 1\nforce_newton = 1\n", False),
        ('environment_kelvin = "warm"\n', False),
        ("environment_kelvin = [300, 301]\n", False),
        ("period_s = 0\n", False),
        ("[plate]\ndrop_rate = 1.0\n", False),
        ("[faults]\nbit_error_rate = 1e-5\nsplit_bytes = 1\nmisbehave = ['limits', 'channels0']\n", True),
        (f"{EVENT}what = 'freeze'\nfor_s = 0.5\n", True),
        (f"{EVENT}what = 'rename'\nto = 'board.1'\n", True),
        (f"{EVENT}what = 'tick_step'\nticks = -5\n", True),
        (f"{EVENT}what = 'rename'\nto = 'a/b'\n", False),
        (f"{EVENT}what = 'sleep'\n", False),
        (EVENT, False),
        ("[faults]\nburst_bits = 17\n", False),
        ("[faults]\nmisbehave = ['cheats']\n", False),
        ("[faults]\nunplug_at_s = 3\n", False),
    ],
)
def test_it_takes_what_the_emulator_takes_and_nothing_else(tmp_path: Path, text: str, right: bool) -> None:
    assert VALIDATOR.is_valid(tomllib.loads(text)) == right
    path = tmp_path / "mine.toml"
    path.write_text(text)
    if right:
        load_scenario(str(path), load_plate("quartz16"))
    else:
        with pytest.raises(ValueError, match=r"mine\.toml"):
            load_scenario(str(path), load_plate("quartz16"))
