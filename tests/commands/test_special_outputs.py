"""Pipes and devices as outputs: written to as they are, never replaced, never removed; a file's name is taken once."""

import io
import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from resonator_daemon.commands import main
from resonator_daemon.host.new_file import takes_a_stream

CORPUS: Final = Path(__file__).parents[1] / "corpus"


@pytest.mark.parametrize(
    "arguments",
    [
        ("export", "--output", "taken.csv", "--topics", "forces"),
        ("replay", "--to", "taken.csv"),
        ("replay", "--save-case", "taken.csv"),
    ],
)
def test_a_name_that_is_taken_is_no_matter_of_the_configuration(
    arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken.csv").write_text("mine")
    verb, *options = arguments
    assert main([verb, str(CORPUS / "touches" / "recording.mcap"), *options, "--json"]) == 78
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "output"
    assert Path("taken.csv").read_text() == "mine"


@pytest.mark.parametrize(
    "arguments",
    [
        ("replay", "--to"),
        ("export", "--topics", "forces", "--format", "csv", "--output"),
        ("export", "--topics", "forces", "--format", "parquet", "--output"),
        *(("export", "--format", form, "--output") for form in ("npz", "mcap", "ros2")),
    ],
    ids=("replay", "csv", "parquet", "npz", "mcap", "ros2"),
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
    if "npz" in command:
        with np.load(file) as one, np.load(io.BytesIO(content)) as other:
            assert one.files == other.files
            np.testing.assert_equal(other["forces/t_ns"], one["forces/t_ns"])
    else:
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
    said = capsys.readouterr().err
    assert "No space left on device" in said
    assert "removed" not in said


def test_a_device_that_nothing_was_written_to_stays(tmp_path: Path) -> None:
    null = tmp_path / "null"
    null.symlink_to("/dev/null")  # a mistake removes the link, not the device
    recording = str(CORPUS / "touches" / "recording.mcap")
    assert main(["replay", recording, "--from", "100", "--to", str(null)]) == 1
    assert null.is_symlink()


def test_many_tables_do_not_go_to_one_pipe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = tmp_path / "out.csv"
    os.mkfifo(pipe)
    assert main(["export", str(CORPUS / "touches" / "recording.mcap"), "--output", str(pipe)]) == 2
    assert f"--output {pipe} takes one table of csv, not 6; choose it by --topics" in capsys.readouterr().err
