"""`resonatord calibrate` as a process on an emulated board: stages, accepts, aborts, and what a kill leaves behind."""

import json
import os
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import exit_code
from emulated_loads import TRUE, Touches, nominal_text, true_text
from emulation import emulated

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config import load_config
from resonator_daemon.tools.calibration.steps import STANDARD_GRAVITY
from simulators.emulator import EmulatorOptions

MASSES = (0.1, 0.3, 0.5)
SPEED = 10.0
TIMEOUT_S = 60
ABORTED = {"verb": "calibrate", "ok": True, "result": "aborted"}
NOTHING_STAGED = {**ABORTED, "id": None, "output": None, "record": None, "notes": [], "staged": False}
LOADS = ("--sites", "7", "--masses-grams", "100,300,500", "--hold-s", "0.3")


class Desk:
    """A folder with a configuration, its plate file, a board, and a state directory."""

    def __init__(self, folder: Path, nominal: str | None = None) -> None:
        nominal = nominal or nominal_text()
        self.folder = folder / "desk"
        self.folder.mkdir()
        self.state = folder / "state"
        self.port = folder / "board"
        self.true = folder / "true.toml"
        self.true.write_text(true_text(nominal))
        self.plate = self.folder / "plate.toml"
        self.plate.write_text(nominal)
        self.config = self.folder / "board.toml"
        self.config.write_text(
            f'plate = "plate.toml"\nlink = "serial:{self.port}?baud=4000000"\n[measurement]\nstep_ms = 10\n'
        )
        self.touches = Touches()

    def loads(self) -> None:
        for mass_kg in MASSES:
            self.touches.load(7, mass_kg, 0.3)

    @contextmanager
    def board(self) -> Iterator[None]:
        scenario = self.touches.write(self.folder.parent)
        with emulated(EmulatorOptions(str(self.true), pty=self.port, scenario=scenario, speed=SPEED)):
            yield

    def start(self, *arguments: str, stdin: int = subprocess.DEVNULL) -> subprocess.Popen[str]:
        command = [
            sys.executable,
            "-m",
            "resonator_daemon.commands",
            "calibrate",
            "--config",
            str(self.config),
            "--json",
        ]
        return subprocess.Popen(
            [*command, *arguments],
            env=os.environ | {"XDG_STATE_HOME": str(self.state)},
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, *arguments: str, stdin: int = subprocess.DEVNULL) -> tuple[int, list[dict[str, Any]], str]:
        """Calibrate in a process of its own."""
        process = self.start(*arguments, stdin=stdin)
        try:
            printed, reported = process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()
        assert "Traceback" not in reported, reported
        return process.returncode, [json.loads(line) for line in printed.splitlines()], reported

    def say(self, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, list[dict[str, Any]], str]:
        """Calibrate in this process."""
        capsys.readouterr()
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_STATE_HOME", str(self.state))
            code = exit_code("calibrate", "--config", self.config, "--json", *arguments)
        printed, reported = capsys.readouterr()
        return code, [json.loads(line) for line in printed.splitlines()], reported

    def tree(self) -> dict[str, bytes]:
        return {str(path.relative_to(self.folder)): path.read_bytes() for path in self.folder.rglob("*")}

    def sessions(self) -> list[str]:
        return sorted(path.name for path in self.state.rglob("*.jsonl"))


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


def refusal(desk: Desk, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Return exit code and code of the error."""
    code, printed, _ = desk.say(capsys, *arguments)
    return code, printed[-1]["error"]["code"]


def sensitivity_error(desk: Desk) -> float:
    found = load_plate(str(desk.plate)).tones.sensitivity[6]
    return float(np.abs(found / TRUE.tones.sensitivity[6] - 1).max())


def test_an_accepted_calibration_is_in_the_plate_file(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    desk.plate.write_text(desk.plate.read_text() + '\n[calibration]\nunit = "RD-0042"\n')  # of the board before
    desk.loads()
    with desk.board():
        code, printed, reported = desk.say(capsys, *LOADS, "--accept", "--kelvin", "297.5")
    assert code == 0, reported
    assert [line["event"] for line in printed[:-1]] == ["untouched"] + 3 * ["place", "captured", "remove"]
    assert printed[2]["force_newton"] == pytest.approx(0.1 * STANDARD_GRAVITY)
    assert [line["residual_newton"] is None for line in printed if line.get("event") == "captured"] == [
        True,
        True,
        False,
    ]
    result = printed[-1]
    assert result["result"] == "accepted"
    calibration = load_plate(str(desk.plate)).calibration
    assert (calibration.id, calibration.unit) == (result["id"], "EMU-0001")
    assert calibration.temperature_kelvin == 297.5
    written, record = tomllib.loads(desk.plate.read_text())["calibration"], result["record"]
    assert {key: record[key] for key in written} == written | {key: str(written[key]) for key in ("date", "expiry")}
    assert record.keys() - written.keys() == {"coupling", "response", "tones"}  # none was found; as of other tables
    assert sensitivity_error(desk) < 3e-3
    assert desk.sessions() == [f"{result['id']}.jsonl"]  # what was captured stays, under the calibration's id
    assert sorted(os.listdir(desk.folder)) == ["board.toml", "plate.toml"]


def test_a_staged_calibration_waits_and_is_accepted_or_aborted(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    before = desk.tree()
    desk.loads()
    with desk.board():
        code, printed, _ = desk.say(capsys, *LOADS, "--output", str(desk.folder / "new.toml"))
    assert (code, printed[-1]["result"]) == (0, "staged")
    assert desk.tree() == before
    assert refusal(desk, capsys, *LOADS) == (2, "usage")
    printed = printed[-1:]
    staged = {path.name: path.read_bytes() for path in desk.state.rglob("*.jsonl")}

    code, aborted, _ = desk.say(capsys, "--abort")
    assert (code, aborted) == (0, [printed[0] | {"result": "aborted", "staged": True}])
    assert desk.tree() == before
    assert desk.sessions() == []
    assert refusal(desk, capsys, "--accept-staged") == (1, "not_calibrated")

    for name, content in staged.items():
        (desk.state / "resonatord" / "calibrations" / name).write_bytes(content)
    original = desk.plate.read_text()
    desk.plate.write_text(original + "# a line more\n")
    assert refusal(desk, capsys, "--accept-staged") == (1, "not_calibrated")
    assert desk.plate.read_text() == original + "# a line more\n"
    desk.plate.write_text(original)
    config = desk.config.read_text()
    code, printed, _ = desk.say(capsys, "--accept-staged", "--apply")
    assert (code, printed[-1]["result"]) == (0, "accepted")
    assert desk.config.read_text() == config.replace("plate.toml", "new.toml")
    assert load_config(desk.config).plate.calibration.id == printed[-1]["id"]
    desk.plate = desk.folder / "new.toml"
    assert sensitivity_error(desk) < 3e-3


@pytest.mark.parametrize("event", ["place", "staged"])
def test_killed_at_any_step_everything_is_as_before(desk: Desk, event: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = desk.tree()
    desk.loads()
    with desk.board():
        process = desk.start(*LOADS)
        assert process.stdout is not None
        for line in process.stdout:
            news = json.loads(line)
            if event in (news.get("event"), news.get("result")):
                break
        else:
            pytest.fail(f"it ended before {event}")
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert desk.tree() == before
    assert len(desk.sessions()) == 1
    code, printed, _ = desk.say(capsys, "--abort")
    assert code == 0
    (aborted,) = printed
    assert aborted == (news | {"result": "aborted", "staged": True} if event == "staged" else NOTHING_STAGED)
    assert desk.sessions() == []


def test_a_bad_load_is_asked_for_once_more_and_a_person_is_asked_to_accept(desk: Desk) -> None:
    masses = (0.1, 0.2, 0.3, 0.4, 0.5)
    for mass_kg in masses:
        desk.touches.load(7, 0.25 if mass_kg == 0.3 else mass_kg, 0.3)
    desk.touches.load(7, 0.3, 0.3)
    grams = ("--sites", "7", "--masses-grams", "100,200,300,400,500", "--hold-s", "0.3")
    with desk.board():
        keyboard, terminal = os.openpty()
        os.write(keyboard, b"yeah\ny\n")
        code, printed, reported = desk.run(*grams, stdin=terminal)
        os.close(keyboard)
        os.close(terminal)
    assert code == 0, reported
    assert reported.count("accept? [y/N]") == 2
    assert printed[-1]["result"] == "accepted"
    assert [line["step"] for line in printed if line.get("event") == "captured"] == [1, 2, 3, 4, 5, 3]
    assert sensitivity_error(desk) < 3e-3
