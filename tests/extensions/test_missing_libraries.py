"""An extension without its library is one message when it is used, and no other command needs the library."""

import os
from pathlib import Path

import pytest
from command_line import run_command

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
        done = run_command(*words, env=os.environ | {"PYTHONPATH": str(tmp_path)}, cwd=tmp_path)
        return done.returncode, done.stderr.splitlines()

    code, (message,) = run(*words)
    assert (code, f"pip install {library}" in message) == (ExitCode.CONFIG, True)
    assert not (tmp_path / "out.mcap").exists()
    assert run("export", RECORDING, "--topics", "forces", "--output", "out.csv")[0] == 0
