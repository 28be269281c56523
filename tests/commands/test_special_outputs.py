"""Pipes and devices as outputs: written to as they are, never replaced, never removed; a file's name is taken once."""

import os
import subprocess
import tempfile
from pathlib import Path
from typing import Final

import pytest

from resonator_daemon.base.host.files import takes_a_stream
from resonator_daemon.commands import main

CORPUS: Final = Path(__file__).parents[1] / "corpus"


@pytest.mark.parametrize(
    "arguments",
    [
        ("replay", "--to"),
        ("export", "--topics", "forces", "--format", "csv", "--output"),
        ("export", "--topics", "forces", "--format", "parquet", "--output"),
        *(("export", "--format", form, "--output") for form in ("mcap", "ros2")),
    ],
    ids=("replay", "csv", "parquet", "mcap", "ros2"),
)
def test_a_pipe_and_a_device_take_what_a_file_would(
    arguments: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *options = arguments
    command = [verb, str(CORPUS / "touches" / "recording.mcap"), *options]
    file, pipe = tmp_path / "file", tmp_path / "pipe"
    assert main([*command, str(file)]) == 0
    os.mkfifo(pipe)
    with tempfile.TemporaryFile() as read:
        reader = subprocess.Popen(["cat", str(pipe)], stdout=read)
        try:
            assert main([*command, str(pipe)]) == 0
            assert reader.wait(60) == 0
        finally:
            reader.kill()  # where nobody wrote
            reader.wait()
        read.seek(0)
        content = read.read()
    assert takes_a_stream(pipe)  # it is still there
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["file", "pipe"]
    assert content == file.read_bytes()
    capsys.readouterr()
    null, full = tmp_path / "null", tmp_path / "full"  # links: a mistake removes these, and no device
    null.symlink_to("/dev/null")
    full.symlink_to("/dev/full")
    assert main([*command, str(null)]) == 0
    if verb == "export":
        assert capsys.readouterr().err.startswith(f"{null}: {len(content) / 1e3:.0f} kB\n")
    assert main([*command, str(full)]) == 1
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["file", "full", "null", "pipe"]
    printed = capsys.readouterr().err
    assert "No space left on device" in printed
    assert "removed" not in printed


def test_many_tables_do_not_go_to_one_pipe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = tmp_path / "out.csv"
    os.mkfifo(pipe)
    assert main(["export", str(CORPUS / "touches" / "recording.mcap"), "--output", str(pipe)]) == 2
    assert f"--output {pipe} takes one table of csv, not 6; choose it by --topics" in capsys.readouterr().err
