"""`resonatord calibrate` as a process on an emulated board: what is accepted, refused, or left behind by a kill."""

import io
import json
import os
import signal
import subprocess
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import PROGRAM, exit_code
from emulated_loads import TRUE, Touches, nominal_text, true_text
from emulation import emulated

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config import load_config
from resonator_daemon.tools.calibration.steps import STANDARD_GRAVITY
from simulators.emulator import EmulatorOptions

MASSES = (0.1, 0.3, 0.5)
SPEED = 10.0
TIMEOUT_S = 60
LOADS = ("--sites", "7", "--masses-grams", "100,300,500", "--hold-s", "0.3")


class Desk:
    """A folder with a configuration, its plate file, and a board."""

    def __init__(self, folder: Path, nominal: str | None = None) -> None:
        nominal = nominal or nominal_text()
        self.folder = folder / "desk"
        self.folder.mkdir()
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
        command = [*PROGRAM, "calibrate", "--config", str(self.config), "--json", *arguments]
        return subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

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
        code = exit_code("calibrate", "--config", self.config, "--json", *arguments)
        printed, reported = capsys.readouterr()
        return code, [json.loads(line) for line in printed.splitlines()], reported

    def tree(self) -> dict[str, bytes]:
        return {str(path.relative_to(self.folder)): path.read_bytes() for path in self.folder.rglob("*")}


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


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
    result = printed[-1]
    assert result["ok"] is True
    calibration = load_plate(str(desk.plate)).calibration
    assert (calibration.id, calibration.unit) == (result["id"], "EMU-0001")
    assert calibration.temperature_kelvin == 297.5
    written, record = tomllib.loads(desk.plate.read_text())["calibration"], result["record"]
    assert {key: record[key] for key in written} == written | {key: str(written[key]) for key in ("date", "expiry")}
    assert record.keys() - written.keys() == {"coupling", "response", "tones"}  # none was found; as of other tables
    assert sensitivity_error(desk) < 3e-3
    assert sorted(os.listdir(desk.folder)) == ["board.toml", "plate.toml"]


def test_a_new_plate_file_needs_no_consent_and_is_configured(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    before, config = desk.plate.read_text(), desk.config.read_text()
    desk.loads()
    with desk.board():
        code, printed, _ = desk.say(capsys, *LOADS, "--output", str(desk.folder / "new.toml"), "--apply")
    assert (code, desk.plate.read_text()) == (0, before)
    assert desk.config.read_text() == config.replace("plate.toml", "new.toml")
    assert load_config(desk.config).plate.calibration.id == printed[-1]["id"]
    desk.plate = desk.folder / "new.toml"
    assert sensitivity_error(desk) < 3e-3


def test_where_nobody_can_be_asked_consent_comes_first(
    desk: Desk, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    code, printed, _ = desk.say(capsys, *LOADS)
    assert (code, printed[-1]["error"]["code"]) == (2, "usage")


def test_killed_at_a_step_everything_is_as_before(desk: Desk) -> None:
    before = desk.tree()
    desk.loads()
    with desk.board():
        process = desk.start(*LOADS, "--accept")
        assert process.stdout is not None
        assert any(json.loads(line)["event"] == "place" for line in process.stdout)
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert desk.tree() == before


@pytest.mark.parametrize(("answers", "code"), [(b"yeah\n\ny\n", 0), (b"n\n", 1)])
def test_a_bad_load_is_requested_again_and_a_person_is_asked_to_accept(desk: Desk, answers: bytes, code: int) -> None:
    before = desk.tree()
    masses = (0.1, 0.2, 0.3, 0.4, 0.5)
    for mass_kg in masses:
        desk.touches.load(7, 0.25 if mass_kg == 0.3 else mass_kg, 0.3)
    desk.touches.load(7, 0.3, 0.3)
    grams = ("--sites", "7", "--masses-grams", "100,200,300,400,500", "--hold-s", "0.3")
    with desk.board():
        keyboard, terminal = os.openpty()
        os.write(keyboard, answers)
        ended, printed, reported = desk.run(*grams, stdin=terminal)
        os.close(keyboard)
        os.close(terminal)
    assert ended == code, reported
    assert reported.count("accept? [y/n]") == answers.count(b"\n")
    assert printed[-1]["record"]["sites"] == [7]
    assert [line["step"] for line in printed if line.get("event") == "captured"] == [1, 2, 3, 4, 5, 3]
    if code:
        assert desk.tree() == before
    else:
        assert sensitivity_error(desk) < 3e-3
