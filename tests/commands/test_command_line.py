"""The command line as a user meets it: exit codes, one clear line for each mistake, JSON for programs."""

import json
import os
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from command_line import PROGRAM, exit_code, run_command

from resonator_daemon.board.config import load_config
from resonator_daemon.commands._command_line import command_names
from resonator_daemon.mqtt.asyncapi import document
from resonator_daemon.tools.demo.run import DemoOptions

ALL = tuple(command_names())


class Printed(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


Resonatord = Callable[..., Printed]


@pytest.fixture
def resonatord(capsys: pytest.CaptureFixture[str]) -> Resonatord:
    """The command, in the test's own process."""

    def run(*arguments: str) -> Printed:
        return Printed(exit_code(*arguments), *capsys.readouterr())

    return run


@pytest.fixture
def config_path(tmp_path: Path, resonatord: Resonatord) -> Path:
    path = tmp_path / "board.toml"
    path.write_text(resonatord("config", "example").stdout)
    return path


@pytest.mark.parametrize("name", ALL)
def test_each_command_explains_itself(name: str, resonatord: Resonatord) -> None:
    run = resonatord(*name.split(), "--help")
    assert run.returncode == 0
    assert run.stdout.startswith(f"usage: resonatord {name} [-h]")
    assert f"Example: resonatord {name} " in f"{' '.join(run.stdout.split())} " or name == "install"  # by sudo
    assert ("--json" in run.stdout) == (name not in ("bridge home-assistant", "bridge ros2", "decode", "run"))


def test_its_version_is_that_of_the_project(resonatord: Resonatord) -> None:
    project = tomllib.loads(Path(__file__).parents[2].joinpath("pyproject.toml").read_text())["project"]
    assert resonatord("--version") == (0, f"resonatord {project['version']}\n", "")


@pytest.mark.parametrize(
    ("line", "usage", "meant"),
    [
        ("", "", ""),
        ("fly", "", ""),
        ("rcord --config x.toml", "", "record"),
        ("plan code", " plan", "codes"),
        ("run", " run", "FILE or --config"),
        ("run --conifg x.toml", " run", "--config"),
        ("watch --pref", " watch", "--prefix"),
        ("doctor --secnds 3", " doctor", "--seconds"),
        ("plan codes --grid 4x4 --pitchmm=5", " plan codes", "--pitch-mm"),
        ("calibrate skni --config x.toml", " calibrate", "skin"),
        ("emulate --plate quartz16", " emulate", "--pty or --tcp or --usb"),
        ("demo --seconds -1", " demo", ""),
        ("bridge home-assistant --plate a/#", " bridge home-assistant", ""),
    ],
)
def test_usage_errors_exit_with_2_and_a_usage(line: str, usage: str, meant: str, resonatord: Resonatord) -> None:
    run = resonatord(*line.split())
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr.startswith(f"usage: resonatord{usage} [-h]")
    last = run.stderr.splitlines()[-1]
    assert last.startswith(f"resonatord{usage}: error: ")
    assert last.endswith((f"did you mean {meant}?", f" give {meant}")) or not meant


def test_the_example_passes_its_own_check(config_path: Path, resonatord: Resonatord) -> None:
    headers = [line for line in config_path.read_text().splitlines() if line.startswith("[")]
    assert headers == ["[mqtt]", "[measurement]", "[decoding]", "[commands]"]
    run = resonatord("check", str(config_path), "--json")
    assert run.returncode == 0
    found = json.loads(run.stdout)
    assert (found["ok"], found["verb"], found["errors"], found["notes"]) == (True, "check", [], [])
    assert load_config(config_path).measurement.window_s == pytest.approx(0.01)


@pytest.mark.parametrize(
    "arguments", [("--help",), ("plan", "--help"), ("repair", "-h"), ("emulate", "--scenario-schema"), ("schema",)]
)
def test_what_cannot_be_printed_fails(arguments: tuple[str, ...]) -> None:
    with open("/dev/full", "w") as full:
        run = subprocess.run(
            [*PROGRAM, *arguments], stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=60
        )
    assert run.returncode == 1
    assert run.stderr == "resonatord: No space left on device\n"


EXTENSION = {
    "wave.py": "'Wave.'\ndef add_arguments(parser): pass\ndef run(arguments): return 3",
    "lacks.py": "def run(arguments): return 0",
    "group/__init__.py": "'Group.'",
    "group/fails.py": "raise ValueError('no such device')",
    "extension-1.dist-info/METADATA": "Metadata-Version: 2.1\nName: extension\nVersion: 1",
    "extension-1.dist-info/entry_points.txt": "[resonatord.commands]\n"
    "wave = wave\nlacks = lacks\ngroup = group\nrepair = lacks",
}


def test_a_command_of_an_extension_fails_alone(tmp_path: Path) -> None:
    for name, text in EXTENSION.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)

    def run(*words: str) -> tuple[int, str, list[str]]:
        done = run_command(*words, env=os.environ | {"PYTHONPATH": str(tmp_path)})
        left_out = [line.split()[2] for line in done.stderr.splitlines() if line.startswith("warning: extension ")]
        return done.returncode, done.stdout, left_out

    code, text, left_out = run("--help")
    assert (code, left_out) == (0, ["group", "lacks"])
    assert "    wave             wave\n" in text
    assert run("wave") == (3, "", [])
    assert run("lacks") == (2, "", ["lacks", "group"])
    assert run("repair", "--help")[::2] == (0, [])  # no extension is loaded for a command of the product


@pytest.mark.parametrize("form", [(), ("--json",)])
def test_schema_prints_the_document_of_daemons(form: tuple[str, ...], resonatord: Resonatord) -> None:
    printed = resonatord("schema", *form).stdout
    assert json.loads(printed) == document()
    assert (printed.count("\n") == 1) == bool(form)


def test_emulate_states_its_link_first_and_its_accounts_last(tmp_path: Path) -> None:
    port = tmp_path / "board"
    command = [*PROGRAM, "emulate", "--plate", "quartz16", "--pty", str(port), "--json"]
    emulator = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert json.loads(emulator.stdout.readline()) == {
        "link": f"serial:{port}?baud=4000000",
        "plate": "quartz16",
        "serial_number": "EMU-0001",
    }
    assert port.is_symlink()
    emulator.send_signal(signal.SIGINT)
    report, _ = emulator.communicate(timeout=30)
    assert emulator.returncode == 0
    assert json.loads(report)["frames_made"] == 0
    assert not port.is_symlink()


@pytest.mark.parametrize(
    ("arguments", "terminal", "shown"),
    [((), True, (True, True)), (("--headless",), True, (False,) * 2), ((), False, (True, False))],
)
def test_the_demo_has_a_page_everywhere_and_a_view_in_a_terminal(
    arguments: tuple[str, ...], terminal: bool, shown: tuple[bool, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[DemoOptions] = []
    monkeypatch.setattr("resonator_daemon.tools.demo.run.run_demo", lambda options: seen.append(options) or 0)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    assert exit_code("demo", *arguments) == 0
    assert [(options.has_page, options.has_view) for options in seen] == [shown]
