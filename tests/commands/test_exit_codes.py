"""Exit codes that all commands share: wrong arguments, an output that is there, a reader that left, Ctrl-C."""

import importlib
import json
import pkgutil
import shlex
import signal
import subprocess
import tomllib
from contextlib import suppress
from pathlib import Path

import pytest
from command_line import PROGRAM, exit_code

import resonator_daemon
from resonator_daemon.base.errors import FAILURES, MissingLibraryError, UserError
from resonator_daemon.commands._command_line import command_names

RECORDING = Path(__file__).parents[1] / "corpus" / "touches" / "recording.mcap"
FAILING = tomllib.loads(Path(__file__).with_name("failing_commands.toml").read_text())["failure"]
LINES = [(line, failure["exit_code"], failure["code"]) for failure in FAILING for line in failure["commands"]]
LINES += [(f"{name} --nope", 2, "usage") for name in command_names() if name not in ("decode", "run")]


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """A recording, which is in the present folder whole and cut off."""
    monkeypatch.chdir(tmp_path)
    recorded = RECORDING.read_bytes()
    (tmp_path / "run.mcap").write_bytes(recorded)
    (tmp_path / "cut.mcap").write_bytes(recorded[: len(recorded) // 2])
    return recorded


@pytest.mark.parametrize(("line", "code", "word"), LINES)
def test_every_failure_is_one_object_with_a_code(
    line: str, code: int, word: str, tmp_path: Path, recorded: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run.txt").write_text("nope")
    broker = '[mqtt]\nurl = "mqtt://127.0.0.1:9"\n'
    (tmp_path / "client.toml").write_text(f'name = "left"\n{broker}')
    for name, plate in (("board", "quartz16"), ("skin", "skin32")):
        (tmp_path / f"{name}.toml").write_text(f'plate = "{plate}"\nlink = "tcp://127.0.0.1:9"\n{broker}')
    ended = exit_code(*shlex.split(line), "--json")
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert (ended, result["ok"], result["error"]["code"], "Traceback" in printed.err) == (code, False, word, False)
    assert result["error"]["message"] and line.startswith(result["verb"])  # noqa: PT018


def test_every_error_has_a_documented_code() -> None:
    for found in pkgutil.walk_packages(resonator_daemon.__path__, "resonator_daemon."):
        if not found.name.endswith("__main__"):
            with suppress(ModuleNotFoundError, MissingLibraryError):  # of a library that is optional
                importlib.import_module(found.name)
    kinds = [UserError]
    for kind in kinds:
        kinds += kind.__subclasses__()
    assert {kind.code for kind in kinds} <= FAILURES.keys()


@pytest.mark.parametrize(
    "line",
    [
        "run FILE", "check FILE", "record FILE --output run.mcap", "tare FILE", "decode FILE",
        "doctor FILE --seconds 1", "identify FILE", "calibrate FILE --masses-grams 100",
        "calibrate skin FILE --ball 5 --load-newton 1", "watch FILE"
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["gone.toml", "--config gone.toml", "gone.toml --config gone.toml"])
def test_a_configuration_is_an_argument_or_an_option(
    line: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    twice = name.startswith("gone.toml --")
    assert exit_code(*shlex.split(line.replace("FILE", name))) == (2 if twice else 78)
    assert ("gone.toml: no such file" in capsys.readouterr().err) == (not twice)


@pytest.mark.parametrize(
    "line",
    [
        "record --config board.toml --output there --seconds 1",
        "replay run.mcap --to there",
        "export run.mcap --output there --format mcap",
        "repair cut.mcap --output there",
        "plan codes --grid 4x4 --pitch-mm 5 --output there",
        "calibrate --config board.toml --masses-grams 100 --output there",
    ],
)
def test_an_output_that_is_there_is_not_overwritten(
    line: str, tmp_path: Path, recorded: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "board.toml").write_text('plate = "quartz16"\nlink = "tcp://127.0.0.1:9"\n')
    (tmp_path / "there").write_bytes(b"mine")
    assert exit_code(*shlex.split(line)) == 78
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "there").read_bytes() == b"mine"


@pytest.mark.parametrize("line", [f"replay {RECORDING} --to -", "schema"])
def test_a_reader_that_leaves_ends_it_well(line: str) -> None:
    """As `| head -c 1` does; the rest is more than a pipe holds."""
    command = subprocess.Popen([*PROGRAM, *shlex.split(line)], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert command.stdout.read(1) == b"{"
    command.stdout.close()
    stderr = command.stderr.read()
    command.stderr.close()
    assert command.wait(60) == 0, stderr
    assert b"Error" not in stderr


def test_ctrl_c_before_a_board_counts_interrupts_a_recording(tmp_path: Path) -> None:
    config = tmp_path / "board.toml"
    config.write_text(f'plate = "quartz16"\nlink = "serial:{tmp_path}/board?baud=4000000"\n')
    output = tmp_path / "run.mcap"
    command = [*PROGRAM, "record", "--config", str(config), "--output", str(output), "--json"]
    record = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for line in record.stderr:
        if "no port" in line:
            break
    record.send_signal(signal.SIGINT)
    stdout, stderr = record.communicate(timeout=60)
    assert record.returncode == 1, stderr
    assert '"code": "interrupted"' in stdout
    assert not output.exists()


@pytest.mark.parametrize("files", [5, 8])
def test_too_few_open_files_are_a_matter_of_configuration(files: int) -> None:
    command = ["bash", "-c", f'ulimit -n {files}; exec "$@"', "-", *PROGRAM, "watch", "--url", "mqtt://127.0.0.1:9"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout, len(ended.stderr.splitlines())) == (78, "", 1)
