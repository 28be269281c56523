"""The extension in docs/examples, installed into a directory of its own and used by the product as it is."""

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

from command_line import run_command

from resonator_daemon.board.recording.reader import open_recording

ROOT = Path(__file__).parents[2]
RECORDING = ROOT / "tests" / "corpus" / "touches" / "recording.mcap"
TOUCHES = ROOT / "tests" / "corpus" / "comb" / "recording.mcap"
PIP = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index")


def test_carrier_export_finding_and_sensor_of_another_package(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "docs" / "examples" / "extension", tmp_path / "source")
    subprocess.run([*PIP, "--target", tmp_path / "installed", tmp_path / "source"], check=True, timeout=120)

    def run(*words: object) -> dict[str, Any]:
        done = run_command(*words, "--json", env=os.environ | {"PYTHONPATH": str(tmp_path / "installed")}, cwd=tmp_path)
        assert "warning" not in done.stderr
        printed: dict[str, Any] = json.loads(done.stdout)
        return printed

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        board.bind(("127.0.0.1", 0))
        link = f"udp://127.0.0.1:{board.getsockname()[1]}"
        (tmp_path / "board.toml").write_text(f'plate = "quartz16"\nlink = "{link}"\n')
        assert run("check", "board.toml")["ok"]
        assert run("identify", link)["error"]["code"] == "no_board"
        assert board.recv(1000)  # what was asked came as a datagram
        findings = run("doctor", "board.toml", "--seconds", 1)["findings"]
    assert [(found["area"], found["outcome"]) for found in findings if found["id"] == "example.room"] == [
        ("sensor", "not_checked")
    ]
    with open_recording(str(TOUCHES)) as recording:
        plate = recording.plate_text
    (tmp_path / "comb.toml").write_text(plate.replace('"channelised"', '"channelised"\nsensor = "largest"'))
    (tmp_path / "comb16.toml").write_text(
        f'plate = "comb.toml"\nlink = "{link}"\n[measurement]\nwindow_ms = 20\nstep_ms = 20\n'
    )
    assert run("replay", TOUCHES, "--config", "comb16.toml", "--to", "messages.jsonl")["messages"]["forces"] > 90
    messages = [json.loads(line) for line in (tmp_path / "messages.jsonl").read_text().splitlines()]
    sites = [len(message["payload"]["sites"]) for message in messages if message["topic"] == "forces"]
    assert set(sites) == {0, 1}
    result = run("export", RECORDING, "--output", "run.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "run.jsonl").read_text().splitlines()]
    assert result["rows"] == {"forces": len(lines)}
    assert {line["topic"] for line in lines} == {"forces"}
    assert any(line["sites"] for line in lines)
