"""`resonatord decode-recordings`: equal results for any chunks, workers and kills, and what cannot be decoded."""

import json
import os
import random
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pyarrow.dataset as ds
import pytest
from recording_bench import PLATE, at
from scenarios import press_and_shear
from simulated_recording import record
from small_disk import small_disk
from web_server import served

from resonator_daemon.board.config.values import plate_text
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.writer import Published, RecordingWriter
from resonator_daemon.board.session.link_events import Received
from resonator_daemon.commands import main
from resonator_daemon.extensions.fleet.chunk_decoding import REPORTS
from resonator_daemon.extensions.fleet.outline import read_outline
from resonator_daemon.tools.replay.recorded_pipeline import open_replay

CORPUS = Path(__file__).parents[2] / "corpus"
FILE = "recording.mcap"
CASES = CORPUS / "touches" / FILE, CORPUS / "slide" / FILE
UNDAMAGED = *(FEW := ("touches", "two-touches", "slide")), "comb", "warm-finger", "pressed-at-start", "overload"
PRESSES = 3  # each is followed by more than the 40 untouched frames that a chunk begins with
COUNTED_FROM_A_BEGINNING = {"seq", "contact_id", "patch_id"}


@pytest.fixture(scope="module")
def skin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a small skin, with the messages of its daemon; it begins 14 s before midnight."""
    folder = tmp_path_factory.mktemp("skin")
    with open_replay(CORPUS / "skin" / "recording.mcap") as replaying:
        plate = replaying.config.plate
    scenario = folder / "press.toml"
    scenario.write_text("period_s = 7.0\n" + press_and_shear(5.0, 0.8))
    begin_ns = (1_789_000_000 // 86_400 * 86_400 + 86_400 - 14) * 10**9
    record(path := folder / "run.mcap", plate, 21.0, scenario=str(scenario), include_messages=True, utc_ns=begin_ns)
    return path


def decode(*arguments: object) -> int:
    return main(["decode-recordings", *map(str, arguments)])


def contents(output: Path) -> dict[str, bytes]:
    return {str(path.relative_to(output)): path.read_bytes() for path in output.rglob("*.parquet")}


def columns(output: Path, topic: str) -> dict[str, Any]:
    table = ds.dataset(output / topic, partitioning="hive").to_table().sort_by("t_ns")
    return {name: table[name].to_pylist() for name in table.column_names if name not in COUNTED_FROM_A_BEGINNING}


@pytest.fixture(scope="module")
def reference(skin: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("reference")
    assert decode(skin, "--output", output, "--chunk-seconds", 6.5) == 0
    return output


def test_results_do_not_depend_on_the_chunks_and_lie_by_plate_and_day(
    skin: Path, reference: Path, tmp_path: Path
) -> None:
    assert decode(skin, "--output", tmp_path, "--chunk-seconds", 1e6) == 0
    assert len(list((tmp_path / REPORTS).iterdir())) == 1
    assert len(list((reference / "decoded").rglob("*.parquet"))) > PRESSES  # that at midnight has two
    for topic in ("decoded", "decoded-summary", "contacts", "contacts-event"):
        np.testing.assert_equal(columns(reference, topic), columns(tmp_path, topic))
    assert columns(tmp_path, "contacts-event")["event"].count("onset") == PRESSES
    ids = ds.dataset(reference / "contacts-event").to_table()["contact_id"].to_pylist()
    assert len(set(ids)) == PRESSES
    found = {part.parent.name + "/" + part.name for part in (reference / "contacts").glob("*/*")}
    assert found == {"plate=left-index/day=2026-09-10", "plate=left-index/day=2026-09-11"}
    for day in ("2026-09-10", "2026-09-11"):
        times = ds.dataset(reference / "contacts" / "plate=left-index" / f"day={day}").to_table()["t_ns"].to_numpy()
        assert set((times // 10**9).astype("datetime64[s]").astype("datetime64[D]").astype(str)) == {day}


def test_another_plate_file_gives_other_forces(skin: Path, reference: Path, tmp_path: Path) -> None:
    with open_replay(skin) as replaying:
        plate = replaying.config.plate
    weaker = tmp_path / "weaker.toml"
    grid = plate.grid.model_copy(update={"sensitivity": tuple(2 * part for part in plate.grid.sensitivity)})
    weaker.write_text(plate_text(plate.model_copy(update={"grid": grid})))
    assert decode(skin, "--output", tmp_path / "half", "--plate", weaker) == 0
    usual, half = (
        [force for force in columns(output, "contacts")["contact_force_z_newton"] if force]
        for output in (reference, tmp_path / "half")
    )
    assert np.median(half) == pytest.approx(0.5 * np.median(usual), rel=0.3)


def workers() -> list[psutil.Process]:
    return [child for child in psutil.Process().children(recursive=True) if "spawn_main" in " ".join(child.cmdline())]


def kill_workers(output: Path, done: threading.Event, chances: random.Random, killed: list[int], most: int) -> None:
    """Kill workers at random times while they decode; the first and each fourth of them also while it starts."""
    while not done.wait(chances.uniform(0.01, 0.2)) and len(killed) < most:
        with suppress(psutil.NoSuchProcess):  # it has ended in the meantime
            if (running := workers()) and (len(killed) % 4 == 0 or list(output.glob(".parts/*"))):
                victim = chances.choice(running)
                victim.send_signal(signal.SIGKILL)
                killed.append(victim.pid)


@pytest.mark.parametrize(("source", "kills"), [("corpus", 2), pytest.param("skin", 20, marks=pytest.mark.soak)])
def test_killed_workers_change_nothing(source: str, kills: int, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    recordings = [request.getfixturevalue("skin")] if source == "skin" else [CORPUS / case / FILE for case in FEW]
    arguments = [*recordings, "--chunk-seconds", 6.5]
    assert decode(*arguments, "--output", tmp_path / "undisturbed") == 0
    chances, killed = random.Random(1), list[int]()
    while len(killed) < kills:
        output, done = tmp_path / f"after-{len(killed)}", threading.Event()
        thread = threading.Thread(target=kill_workers, args=(output, done, chances, killed, kills))
        thread.start()
        try:
            assert decode(*arguments, "--output", output, "--workers", 2) == 0
        finally:
            done.set()
            thread.join()
        assert contents(output) == contents(tmp_path / "undisturbed")
        assert os.listdir(output / ".parts") == []


def test_a_repeat_decodes_only_what_is_missing_or_was_truncated(
    skin: Path, reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert decode(skin, "--output", tmp_path, "--scheduler", "foo") == 2  # other settings, and no chunk is begun
    (truncated := tmp_path / skin.name).write_bytes(skin.read_bytes()[: skin.stat().st_size * 7 // 10])
    assert decode(truncated, "--output", tmp_path, "--chunk-seconds", 6.5) == 1
    assert "the file is cut off" in capsys.readouterr().err
    last = sorted((tmp_path / REPORTS).iterdir())[-1].with_suffix(".parquet")
    (stale := tmp_path / "contacts" / "plate=left-index" / "day=2026-09-12" / last.name).parent.mkdir()
    stale.touch()
    assert decode(truncated, skin, "--output", tmp_path, "--chunk-seconds", 6.5, "--json") == 0  # the longer copy
    assert json.loads(capsys.readouterr().out).items() >= {"recordings": 1, "chunks_done_before": 1}.items()
    assert contents(tmp_path) == contents(reference)
    assert decode(truncated, "--output", tmp_path, "--chunk-seconds", 6.5) == 0  # nothing is replaced by less
    one, *others = sorted((tmp_path / REPORTS).iterdir())
    one.unlink()
    times = {path: path.stat().st_mtime_ns for path in others}
    capsys.readouterr()
    assert decode(skin, "--output", tmp_path, "--chunk-seconds", 6.5, "--json") == 0
    assert json.loads(capsys.readouterr().out)["chunks_done_before"] == len(others)
    assert contents(tmp_path) == contents(reference)
    assert times == {path: path.stat().st_mtime_ns for path in others}
    assert decode(skin, "--output", tmp_path, "--chunk-seconds", 14) == 2  # other settings
    assert "choose another --output" in capsys.readouterr().err


def test_a_full_disk_is_one_message_and_the_repeat_goes_on(
    skin: Path, reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result_bytes = sum(map(len, contents(reference).values()))
    with small_disk(tmp_path, 3 * result_bytes) as (disk, _, free):
        (disk / "filler").write_bytes(bytes(5 * result_bytes // 2))
        assert decode(skin, "--output", disk / "out", "--chunk-seconds", 6.5) == 1
        [message] = capsys.readouterr().err.splitlines()
        assert "No space left on device; free space there, and repeat the command" in message
        free()
        assert decode(skin, "--output", disk / "out", "--chunk-seconds", 6.5, "--json") == 0
        assert json.loads(capsys.readouterr().out)["chunks_done_before"] > 0
        assert contents(disk / "out") == contents(reference)


@pytest.mark.soak
def test_a_killed_scheduler_is_one_message_and_the_repeat_goes_on(
    skin: Path, reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, address, ended = tmp_path / "out", tmp_path / "scheduler.json", threading.Event()

    def start(part: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "dask", part, "--scheduler-file", address, *options]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        stack.callback(process.wait)
        stack.callback(process.kill)
        return process

    def kill_scheduler() -> None:
        while not ended.wait(0.02) and not list(output.glob(".parts/*")):
            pass
        scheduler.kill()

    with ExitStack() as stack:
        scheduler, _ = start("scheduler", "--port", "0", "--no-dashboard"), start("worker", "--nthreads", "1")
        while not address.exists() or not address.read_text().endswith("}"):
            assert scheduler.poll() is None
        thread = threading.Thread(target=kill_scheduler)
        thread.start()
        stack.callback(thread.join)
        stack.callback(ended.set)
        url = json.loads(address.read_text())["address"]
        assert decode(skin, "--output", output, "--chunk-seconds", 6.5, "--scheduler", url) == 69
    [message] = capsys.readouterr().err.splitlines()
    assert f"the scheduler at {url} has ended" in message
    assert len(list((output / REPORTS).iterdir())) < len(list((reference / REPORTS).iterdir()))
    assert decode(skin, "--output", output, "--chunk-seconds", 6.5) == 0
    assert contents(output) == contents(reference)


def test_force_plates_are_decoded_as_replayed_and_damage_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "runs").mkdir()
    for case, end_bytes in zip(CASES, (None, -1000), strict=True):
        (tmp_path / "runs" / f"{case.parent.name}.mcap").write_bytes(case.read_bytes()[:end_bytes])
    (tmp_path / "runs" / "no.mcap").write_text("no recording")
    assert decode(tmp_path / "runs" / "*.mcap", "--output", tmp_path / "out", "--json", "--chunk-seconds", 1) == 1
    printed = json.loads(capsys.readouterr().out)
    with open_replay(CASES[0]) as replaying:
        forces = sum(topic.path == "forces" for moment in replaying.moments() for topic, _ in moment.messages)
    assert printed["error"]["code"] == "differs"
    assert "no.mcap is no recording" in printed["error"]["message"]
    assert "the file is cut off" in printed["error"]["message"]
    assert printed["recordings"] == 2
    assert printed["rows"]["forces"] > forces
    for done_before in (2, 1):  # a damaged recording is decoded again once its file has changed
        assert decode(tmp_path / "runs" / "*.mcap", "--output", tmp_path / "out", "--json", "--chunk-seconds", 1) == 1
        repeated = json.loads(capsys.readouterr().out)
        assert (repeated["chunks"], repeated["chunks_done_before"]) == (2, done_before)
        assert "the file is cut off" in repeated["error"]["message"]
        (tmp_path / "runs" / f"{CASES[1].parent.name}.mcap").touch()
    assert decode(CASES[0], "--output", tmp_path / "maps", "--topics", "decoded") == 0
    assert "decoded: no rows" in capsys.readouterr().err


def test_recordings_at_urls_give_the_files_of_local_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = tmp_path / "runs"
    runs.mkdir()
    (runs / "no.mcap").write_text("no recording")
    arguments = ["--topics", "contacts/event", "--json"]
    assert decode(*CASES, "--output", tmp_path / "local", *arguments) == 0
    local = json.loads(capsys.readouterr().out)
    with served(tmp_path) as url:
        login = url.replace("//", "//user:SECRET@")
        for end_bytes in (-1000, None):  # a recording that has grown is decoded again
            for case in CASES:
                (runs / f"{case.parent.name}.mcap").write_bytes(case.read_bytes()[:end_bytes])
            assert decode(f"{login}runs", "--output", tmp_path / "remote-0", *arguments) == 1
        signed = (f"{login}runs/{name}?X-Amz-Signature=SECRET" for name in os.listdir(runs))
        for number, patterns in enumerate(([f"{login}runs"], [f"{login}runs/*.mcap"], signed)):
            output = tmp_path / f"remote-{number}"
            assert decode(*patterns, "--output", output, *arguments) == 1
            printed = json.loads(capsys.readouterr().out.splitlines()[-1])
            assert f"{url}runs/no.mcap is no recording" in printed["error"]["message"]
            assert b"SECRET" not in b"".join(path.read_bytes() for path in output.rglob("*") if path.is_file())
            assert (printed["recordings"], printed["rows"]) == (2, local["rows"])
            np.testing.assert_equal(columns(output, "contacts-event"), columns(tmp_path / "local", "contacts-event"))
        assert decode(f"{login}runs/gone.mcap?sig=SECRET", "--output", tmp_path / "none") == 2
        assert f"recording {url}runs/gone.mcap: no such file" in capsys.readouterr().err
    assert decode(f"{login}runs/*.mcap", "--output", tmp_path / "none") == 1  # no server
    assert f"{url}runs/*.mcap: Connection refused" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (["nothing/*.mcap"], 2, "no file matches"),
        ([CASES[0], "--plate", "skin32"], 2, "'quartz16'"),
        ([CASES[0], "--settings", "missing.toml"], 78, "missing.toml"),
        ([CASES[0], "--topics", "force"], 2, "forces"),
        ([CASES[0], "--scheduler", "tcp://127.0.0.1:1"], 69, "no scheduler answers"),
        ([CASES[0], "--scheduler", "127.0.0.1:1", "--workers", "2"], 2, "--workers"),
        ([CASES[0], "--scheduler", "foo"], 2, "missing port number"),
        ([CASES[0], "--output", "/dev/null/out"], 1, "Not a directory; name a directory in which"),
        ([CASES[0], "--output", "/proc/out"], 1, "No such file or directory; name a directory in which"),
    ],
)
def test_what_cannot_be_done_is_one_message(
    arguments: list[Any],
    code: int,
    word: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("resonator_daemon.extensions.fleet.cluster.CONNECT_S", 0.3)
    assert decode("--output", tmp_path, *arguments) == code
    assert word in capsys.readouterr().err.splitlines()[-1]


def test_parts_have_their_least_length_though_messages_are_late(tmp_path: Path) -> None:
    writer = RecordingWriter(path := tmp_path / "run.mcap", Origin(PLATE, "tcp://board:1"), at(0).utc_ns)
    for now in map(at, range(0, 20_000, 1000)):
        writer.write(Received(now, b"x"))
        if now.utc_ns % 3 == at(0).utc_ns % 3:  # each third
            writer.publish(Published("forces", now.utc_ns - 4 * 10**9, b'{"count":0}', {}, retained=False))
        writer.flush()
    writer.finish()
    writer.close()
    assert [start.utc_ns for start in read_outline(path, 5.0).starts] == [at(5000 * n).utc_ns for n in range(4)]
