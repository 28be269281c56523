"""`resonatord export` as a user meets it: files, memory, one line where something is wrong, and the exit code."""

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from export_bench import interrupt_at, played, recording
from small_disk import file_size_limit

from resonator_daemon.commands import main

FORMATS = ("parquet", "csv", "mcap", "ros2")
SIGNALS = dict(zip(FORMATS, [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTERM], strict=True))


def export(*arguments: object) -> int:
    return main(["export", *map(str, arguments)])


def output(folder: Path, form: str) -> tuple[object, ...]:
    return ("--ros2", "--output", folder / "out.mcap") if form == "ros2" else ("--output", folder / f"out.{form}")


def test_recordings_of_one_plate_become_one_in_time_order(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    empty = tmp_path / "empty"
    empty.mkdir()
    alone = {}
    for name, case in (("a", "overload"), ("b", "touches")):
        shutil.copy(recording(case), folder / f"{name}.mcap")
        assert export(recording(case), "--output", tmp_path / f"{name}.csv", "--topics", "forces") == 0
        alone[name] = (tmp_path / f"{name}.csv").read_text().splitlines()
    capsys.readouterr()
    together = tmp_path / "all.csv"
    assert export(folder, "--output", together, "--topics", "forces", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["recordings"] == [str(folder / "b.mcap"), str(folder / "a.mcap")]
    assert together.read_text().splitlines() == alone["b"] + alone["a"][1:]
    assert printed["rows"] == {"forces": len(alone["a"]) + len(alone["b"]) - 2}
    for wrong in ((folder, "--from", "1"), (folder, recording("comb")), (empty,)):
        assert export(*wrong, "--output", tmp_path / "no.csv", "--topics", "forces") == 2
    assert not (tmp_path / "no.csv").exists()


@pytest.mark.parametrize("form", FORMATS)
def test_a_recording_becomes_files(form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export(recording("touches"), *output(tmp_path, form), "--json") == 0
    reported = json.loads(capsys.readouterr().out)
    assert (reported["verb"], reported["ok"], reported["format"], reported["damage"], reported["differences"]) == (
        "export",
        True,
        form,
        None,
        0,
    )
    assert reported["files"] == {str(path): path.stat().st_size for path in tmp_path.iterdir()}
    assert reported["rows"]["contacts/event"] == len(played("touches").messages("contacts/event"))
    names = {path.name for path in tmp_path.iterdir()}
    if form in ("parquet", "csv"):
        topics = ("forces", "contacts", "contacts-event", "state-link", "state-sensor")
        assert names == {f"out-{topic}.{form}" for topic in topics}
    else:
        assert len(names) == 1


def test_one_topic_is_the_file_that_was_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "events.parquet"
    assert export(recording("touches"), "--output", path, "--topics", "contacts/event") == 0
    assert pq.read_table(path)["event"].to_pylist() == [m.event for m in played("touches").messages("contacts/event")]
    metadata = pq.read_schema(path).metadata
    assert (metadata[b"source"], metadata[b"name"], metadata[b"plate"]) == (
        b"recording.mcap",
        b"left-index",
        b"quartz16",
    )
    assert len(metadata[b"source_sha256"]) == 64
    printed = capsys.readouterr()
    assert printed.out == ""
    assert f"{path}: " in printed.err


def test_the_whole_part_of_a_cut_off_file_is_exported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "forces.csv"
    assert export(recording("cut-off"), "--output", path, "--topics", "forces", "--json") == 1
    printed = capsys.readouterr()
    assert json.loads(printed.out)["damage"] == "cut off"
    assert f"{recording('cut-off')}: the file is cut off; all before that was exported; " in printed.err
    assert len(path.read_text().splitlines()) == 1 + len(played("cut-off").messages("forces"))


def test_where_nothing_follows_no_file_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export(recording("refused"), "--output", tmp_path / "forces.csv", "--topics", "forces") == 1
    printed = capsys.readouterr().err
    assert "the board was refused: plate: the board describes another-plate" in printed
    assert "it gives no messages of forces" in printed
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", FORMATS)
def test_nothing_is_overwritten(form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = {"ros2": "out.mcap", "parquet": "out-contacts.parquet", "csv": "out-state-link.csv"}.get(form, f"out.{form}")
    (tmp_path / name).write_text("mine")
    assert export(recording("touches"), *output(tmp_path, form)) == 78
    assert (
        f"{tmp_path / name} exists already, and nothing is overwritten; choose another file" in capsys.readouterr().err
    )
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("room_bytes", [0, 4000])
@pytest.mark.parametrize("form", FORMATS)
def test_a_disk_that_is_full_keeps_nothing(
    form: str, room_bytes: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with file_size_limit(room_bytes):
        code = export(recording("touches"), *output(tmp_path, form), "--json")
    printed = capsys.readouterr()
    assert code == 1
    assert "cannot be written: File too large; what was written of it is removed\n" in printed.err
    assert json.loads(printed.out)["error"]["code"] == "output"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", FORMATS)
def test_an_interrupt_leaves_nothing(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    interrupt_at(100, monkeypatch, SIGNALS[form])
    assert export(recording("touches"), *output(tmp_path, form)) == 1
    assert capsys.readouterr().err == "resonatord: interrupted: what was written is removed\n"
    assert list(tmp_path.iterdir()) == []


PROGRAM = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from export_bench import write
from resonator_daemon.tools.export import formats
from resonator_daemon.tools.export.output import TableOutput

TableOutput.batch_bytes = 100_000
folder = Path(sys.argv[2])

for turn, times in ((1, 2), (2, 8)):
    for form in formats():
        write(form, folder / f"{turn}-{form}.{form}", "touches", times=times)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def test_four_times_the_messages_take_no_more_memory(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(Path(__file__).parents[2] / "support"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    short_kb, long_kb = map(int, done.stdout.split())
    assert long_kb < 1.1 * short_kb
    assert (tmp_path / "2-csv-forces.csv").stat().st_size > 3.9 * (tmp_path / "1-csv-forces.csv").stat().st_size
