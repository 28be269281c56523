"""Ctrl-C exits with 0 from commands that run until stopped alone; every other one prints that it was interrupted."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np
import pytest
from brokers import Mosquitto
from emulation import emulated
from observer import observe
from test_record import config as record_config

from resonator_daemon.commands import main
from resonator_daemon.demo import latency, latency_figures, latency_report
from resonator_daemon.doctor import run as doctor_run
from resonator_daemon.plate import load_plate
from resonator_daemon.recording.reader import open_recording
from resonator_daemon.replay import checking
from resonator_daemon.session.board_reader import BoardReader
from simulators.emulator import EmulatorOptions

CORPUS: Final = Path(__file__).parents[1] / "corpus"
COMMAND: Final = (sys.executable, "-m", "resonator_daemon")


def interrupt(*_: object, **__: object) -> NoReturn:
    signal.raise_signal(signal.SIGINT)
    raise AssertionError


def error_of(told: dict[str, Any]) -> dict[str, str]:
    error: dict[str, str] = told["error"]
    return error


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        (("ports",), "links.carriers.serial.serial_ports"),
        (("schema",), "publishing.asyncapi.document"),
        (("status",), "monitoring.status_client.ask_all"),
        (("tare", "--config", "hand.toml"), "config.load_client"),
        (("identify", "tcp://127.0.0.1:9"), "links.carriers.tcp.TcpTarget.open"),
        (("calibrate", "skin", "--config", "hand.toml"), "calibration.skin.load_config"),
        (("config", "explain"), "config.help.explained"),
    ],
)
def test_a_verb_with_an_end_of_its_own_fails(
    arguments: tuple[str, ...], where: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(f"resonator_daemon.{where}", interrupt)
    assert main([*arguments, "--json"]) == 1
    said = capsys.readouterr()
    assert said.err == "resonatord: interrupted\n"
    (line,) = said.out.splitlines()
    verb = (
        "calibrate"
        if arguments[0] == "calibrate"
        else " ".join(arguments[:2] if arguments[0] == "config" else arguments[:1])
    )
    assert json.loads(line) == {
        "verb": verb,
        "ok": False,
        "error": {"code": "interrupted", "message": "interrupted", "hint": ""},
    }
    assert main(arguments) == 1
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        (("watch",), "resonator_daemon.view.watch.broker_at"),
        (("run", "--config", "hand.toml"), "resonator_daemon.daemon.config_store.ConfigStore.__init__"),
        (("decode", "--config", "hand.toml"), "resonator_daemon.config.decoder.load_decoder_config"),
        (("emulate", "--plate", "quartz16", "--pty", "board"), "simulators.emulator.run"),
        (("status", "--watch", "--json"), "resonator_daemon.monitoring.status_client.ask_all"),
    ],
)
def test_one_that_runs_until_it_is_stopped_ends_well(
    arguments: tuple[str, ...], where: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(where, interrupt)
    assert main(arguments) == 0
    assert capsys.readouterr() == ("", "")


def test_a_check_of_cases_says_how_many_it_had(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = checking.check_case

    def check_case(directory: Path, expected: Any) -> Any:
        return whole(directory, expected) if directory.name == "refused" else interrupt()

    monkeypatch.setattr(checking, "check_case", check_case)
    cases = [str(CORPUS / name) for name in ("refused", "touches", "comb", "comb")]
    assert main(["replay", "--check", *cases]) == 1
    said = capsys.readouterr()
    assert said.out.startswith("ok      refused: ")
    assert said.err == "resonatord: interrupted: 1 of 3 cases checked, 0 differ\n"
    assert main(["replay", "--json", "--check", *cases]) == 1
    (line,) = capsys.readouterr().out.splitlines()
    told = json.loads(line)
    assert (told["verb"], told["ok"], error_of(told)["code"]) == ("replay", False, "interrupted")
    assert [case["case"] for case in told["cases"]] == ["refused"]


async def test_a_replay_to_a_broker_says_what_it_published(mosquitto: Mosquitto) -> None:
    recording = str(CORPUS / "touches" / "recording.mcap")
    command = [*COMMAND, "replay", recording, "--url", mosquitto.url, "--name", "hand", "--speed", "0.1", "--json"]
    async with observe(mosquitto.url) as heard:
        replay = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        await heard.until_count("resonator/hand/forces", 1)
        replay.send_signal(signal.SIGINT)
        await heard.until_last("resonator/hand/state/daemon", state="offline", reason="replaying recording.mcap: over")
    stdout, stderr = replay.communicate(timeout=30)
    assert replay.returncode == 1
    (line,) = stdout.splitlines()
    told = json.loads(line)
    assert (told["verb"], told["ok"], error_of(told)["code"]) == ("replay", False, "interrupted")
    count = sum(told["messages"].values())
    assert told["messages"]["forces"] >= 1
    assert stderr.startswith(f"resonatord: interrupted: {count} messages were played out, ")


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_a_doctor_says_what_was_found_and_gives_no_verdict(
    form: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor_run, "check_disk", interrupt)
    assert main(["doctor", "--broker", "mqtt://127.0.0.1:1", *form]) == 1
    said = capsys.readouterr()
    if form:
        (line,) = said.out.splitlines()
        told = json.loads(line)
        assert (told["verb"], told["ok"], error_of(told)["code"]) == ("doctor", False, "interrupted")
        count = len(told["findings"])
        assert {finding["id"].partition(".")[0] for finding in told["findings"]} == {"clock"}
        assert "verdict" not in told
        assert said.err == f"resonatord: interrupted: {count} things were looked at, which is not all\n"
    else:
        assert said.out.startswith("software\n")
        assert "verdict" not in said.out


def test_a_recording_that_was_to_take_longer_says_so(tmp_path: Path) -> None:
    output = tmp_path / "run.mcap"
    with emulated(EmulatorOptions("quartz16", tcp=("127.0.0.1", 0))) as emulator:
        path = record_config(tmp_path, emulator.link.address)
        command = [*COMMAND, "record", "--config", str(path), "--output", str(output), "--seconds", "3600", "--json"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while not output.exists() or output.stat().st_size < 50_000:
            assert process.poll() is None
            signal.sigtimedwait([], 0.05)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 1
    (line,) = stdout.splitlines()
    told = json.loads(line)
    assert (told["ok"], error_of(told)["code"], told["file"]) == (False, "interrupted", str(output))
    assert (
        stderr.splitlines()[-1] == f"resonatord: interrupted: {told['seconds']:.1f} of 3600 s are recorded, which stay"
    )
    with open_recording(str(output), load_plate("quartz16")) as recording:
        assert sum(1 for _ in recording.events()) > 0
        assert recording.damage is None


def test_a_recording_without_a_frame_is_no_matter_of_the_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "run.mcap"
    path = record_config(tmp_path, f"serial:{tmp_path / 'none'}?baud=4000000")
    monkeypatch.setattr(BoardReader, "start", lambda _: signal.raise_signal(signal.SIGTERM))
    command = ["record", "--config", str(path), "--output", str(output)]
    assert main([*command, "--seconds", "9"]) == 1
    assert capsys.readouterr().err.endswith("resonatord: interrupted before a frame came; no file is kept\n")
    assert not output.exists()
    assert main(command) == 69
    assert "no frame was recorded" in capsys.readouterr().err


def test_a_replay_to_a_file_that_takes_its_time_says_so(tmp_path: Path) -> None:
    output = tmp_path / "pipe"
    os.mkfifo(output)
    recording = str(CORPUS / "touches" / "recording.mcap")
    command = [*COMMAND, "replay", recording, "--to", str(output), "--speed", "0.001", "--json"]
    replay = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with output.open("rb"):  # upon which it is playing
        replay.send_signal(signal.SIGINT)
        stdout, stderr = replay.communicate(timeout=30)
    assert (replay.returncode, stderr) == (1, "resonatord: interrupted: what was written stays\n")
    assert error_of(json.loads(stdout))["code"] == "interrupted"


def test_a_bench_that_has_measured_nothing_says_so() -> None:
    command = [*COMMAND, "bench", "latency", "--seconds", "600", "--json"]
    bench = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert bench.stderr is not None
    for line in bench.stderr:
        if line.startswith("measuring"):
            break
    bench.send_signal(signal.SIGINT)
    stdout, stderr = bench.communicate(timeout=60)
    assert bench.returncode == 1
    told = json.loads(stdout)
    assert (told["verb"], told["ok"], error_of(told)["code"]) == ("bench latency", False, "interrupted")
    assert stderr.splitlines()[-1] == "resonatord: interrupted before a message was measured"


def test_a_bench_that_has_measured_something_tells_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = latency_figures.Latency(np.array([1.0, 2.0]), 0, 0)
    report = latency_report.LatencyReport("quartz16", "forces", False, "made up", 3.0, figures, None, {}, 0.0)

    async def run(bench: latency._Bench) -> latency_report.LatencyReport:
        bench.cut_short = True
        return report

    monkeypatch.setattr(latency._Bench, "run", run)
    assert main(["bench", "latency", "--seconds", "9", "--json"]) == 1
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert (told["ok"], error_of(told)["code"], told["latency_ms"]["max"]) == (False, "interrupted", 2.0)
    assert said.err == "resonatord: interrupted: measured for 3.0 of 9 s\n"
    assert main(["bench", "latency", "--seconds", "9"]) == 1
    assert capsys.readouterr().out.startswith("quartz16, forces: 3.0 s, broker made up\n")
