"""An extension without its library is one message when it is used, and no other command needs the library."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from resonator_daemon.base.errors import ExitCode

RECORDING = Path(__file__).parents[1] / "corpus" / "touches" / "recording.mcap"


@pytest.mark.parametrize(
    ("library", "words"),
    [
        ("rosbags", ["export", RECORDING, "--ros2", "--output", "out.mcap"]),
        ("cyclonedds", ["bridge", "ros2"]),
        ("foxglove", ["bridge", "foxglove"]),
        ("aiohttp", ["view"]),
        ("distributed", ["decode-recordings", RECORDING, "--output", "out", "--workers", "2"]),
    ],
)
def test_a_missing_library_is_one_message(library: str, words: list[str | Path], tmp_path: Path) -> None:
    (tmp_path / library).mkdir()
    (tmp_path / library / "__init__.py").write_text("raise ImportError")

    def run(*words: str | Path) -> tuple[int, list[str]]:
        command = [sys.executable, "-m", "resonator_daemon.commands", *map(str, words)]
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, timeout=60)
        return done.returncode, done.stderr.splitlines()

    code, (message,) = run(*words)
    assert (code, f"pip install {library}" in message) == (ExitCode.CONFIG, True)
    assert not (tmp_path / "out.mcap").exists()
    assert run("export", RECORDING, "--topics", "forces", "--output", "out.csv")[0] == 0
