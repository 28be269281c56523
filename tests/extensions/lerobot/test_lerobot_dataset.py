"""Datasets for LeRobot: each value against the Parquet export, masks, episodes, interruption and mistakes."""

import json
import os
import shutil
import signal
import subprocess
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from export_bench import interrupt_at, played, recording

from resonator_daemon.board.config.values import plate_text
from resonator_daemon.commands import main
from resonator_daemon.extensions.lerobot.dataset import Dataset, RecordingWriter
from resonator_daemon.extensions.lerobot.features import describe
from resonator_daemon.tools.replay.recorded_pipeline import Moment, RecordingReplay

PYTHON = Path(__file__).parents[3] / "build" / "lerobot" / "bin" / "python"


def dataset(folder: Path, *words: object) -> int:
    return main(["export", *map(str, words), "--output", str(folder), "--format", "lerobot"])


def rows(folder: Path, part: str) -> list[dict[str, Any]]:
    files = sorted((folder / part).glob("*/*.parquet"))
    return [row for file in files for row in pq.read_table(file).to_pylist()]


def table(folder: Path, topic: str) -> dict[int, list[dict[str, Any]]]:
    """Rows of an exported table by time."""
    found: dict[int, list[dict[str, Any]]] = defaultdict(list)
    if (file := folder / f"t-{topic}.parquet").exists():
        for row in pq.read_table(file).to_pylist():
            found[row["t_ns"]].append(row)
    return found


def same(found: Any, expected: Any) -> None:
    np.testing.assert_array_equal(np.ravel(found), np.ravel(expected).astype(np.float32))


@pytest.mark.parametrize("case", ["slide", "overload", "lost-bytes", "comb", "skin"])
def test_each_value_is_that_of_the_tables_and_the_rest_is_masked(case: str, tmp_path: Path) -> None:
    assert main(["export", str(recording(case)), "--output", str(tmp_path / "t.parquet")]) == 0
    assert dataset(tmp_path / "set", recording(case)) == 0
    forces, signals, decoded, contacts = (
        table(tmp_path, name) for name in ("forces", "signals", "decoded", "contacts")
    )
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    frames, times = rows(tmp_path / "set", "data"), sorted(forces or signals)
    assert len(frames) == info["total_frames"] == round((times[-1] - times[0]) * 1e-9 * info["fps"]) + 1
    assert [frame["t_ns"] for frame in frames if frame["t_ns"] in times] == times
    assert (case == "lost-bytes") == (len(frames) > len(times))
    for number, frame in enumerate(frames):
        assert frame["frame_index"] == frame["index"] == number
        assert frame["timestamp"] == np.float32(number / info["fps"])
        found, t_ns = {key.removeprefix("observation.tactile."): value for key, value in frame.items()}, frame["t_ns"]
        if forces:
            (row,) = forces.get(t_ns, [{"status": "lost"}])
            unlisted = 0.0 if row["status"] == "ok" else np.nan
            names = info["features"]["observation.tactile.force"]["names"]
            listed = [row.get(f"{name}_force_newton") for name in names]
            same(found["force"], [unlisted if force is None else force for force in listed])
            assert found["valid"] == bool(np.isfinite(found["force"]).all())
        for name, key, by_time in (("signals", "signals", signals), ("traction", "traction_pascal", decoded)):
            if by_time:
                same(found[name], by_time[t_ns][0][key] if t_ns in by_time else np.full(np.size(found[name]), np.nan))
                assert name == "signals" or found["valid"] == (t_ns in decoded)
        of_frame = contacts.get(t_ns, [])
        unknown: Any = defaultdict(lambda: np.nan)
        touching = [row for row in of_frame if row["contact_id"] is not None]
        largest = max(touching, key=lambda row: row["contact_force_z_newton"], default=unknown)
        at_rest = not touching and bool(of_frame) and of_frame[0]["status"] == "ok"
        axes = "xyz" if signals else "z"
        same(found["contact.force"], [0.0 if at_rest else largest[f"contact_force_{axis}_newton"] for axis in axes])
        known = largest if np.isfinite(largest["contact_force_z_newton"]) else unknown
        same(found["contact.position"], [known[f"contact_position_{axis}_m"] for axis in "xy"])
        if signals:
            same(found["contact.slip_margin"], known["contact_slip_margin"])


def test_an_interrupted_export_is_completed_by_repeating_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    both = [recording("touches"), recording("lost-bytes")]  # the first has the mark "half time"
    assert dataset(tmp_path / "whole", *both) == 0
    capsys.readouterr()
    with monkeypatch.context() as patched:
        interrupt_at(100, patched, signal.SIGINT, (tmp_path / "set/data/chunk-000/file-000.parquet").exists)
        assert dataset(tmp_path / "set", *both) == 1
    assert "complete recordings are kept; repeat the command" in capsys.readouterr().err
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["total_episodes"] == 1
    (tmp_path / "set/data/chunk-000/file-001.parquet.part").write_text("left by a killed export")
    assert dataset(tmp_path / "set", *both) == dataset(tmp_path / "set", *both) == 0
    files = [path.relative_to(tmp_path / "set") for path in (tmp_path / "set").rglob("*.*")]
    assert [f for f in files if (tmp_path / "set" / f).read_bytes() != (tmp_path / "whole" / f).read_bytes()] == []
    episodes, frames = rows(tmp_path / "set", "meta/episodes"), rows(tmp_path / "set", "data")
    assert [row["tasks"] for row in episodes] == [["half time"], ["recording"]]
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in episodes] == [(0, 106), (106, len(frames))]
    assert [frame["task_index"] for frame in frames] == [frame["episode_index"] for frame in frames]
    statistics = json.loads((tmp_path / "set/meta/stats.json").read_text())["observation.tactile.force"]
    force = np.array([frame["observation.tactile.force"] for frame in frames])
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(statistics[name], getattr(np, f"nan{name}")(force, axis=0), rtol=1e-6)


def test_mistakes_change_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    (tmp_path / "plate.toml").write_text(plate_text(played("touches").config.plate))
    broker = 'plate = "plate.toml"\nlink = "tcp://127.0.0.1:1"\n[mqtt]\nurl = "mqtt://127.0.0.1"\n'
    (tmp_path / "faster.toml").write_text(f"{broker}[measurement]\nwindow_ms = 10\nstep_ms = 10\n")
    assert dataset(tmp_path / "set", recording("slide")) == 0
    shutil.copytree(tmp_path / "set", tmp_path / "cut")
    shutil.rmtree(tmp_path / "cut/meta/episodes")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    for code, text, *words in (
        (78, "is no dataset", "mine", recording("slide")),
        (78, "exists already", "mine/notes.txt", recording("slide")),
        (2, "robot_type: small-skin, the dataset has quartz16", "set", recording("skin")),
        (2, "features", "set", recording("touches"), "--topics", "forces"),
        (2, "fps: 100, the dataset has 50", "set", recording("touches"), "--config", tmp_path / "faster.toml"),
        (2, "has none of decoded", "none", recording("slide"), "--topics", "decoded"),
        (78, "meta/episodes are missing", "cut", recording("touches")),
        (1, "was refused", "none", recording("refused")),
    ):
        assert dataset(tmp_path / str(words[0]), *words[1:]) == code
        assert text in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


def test_gaps_are_by_the_board_s_time_and_a_long_one_or_a_restart_begins_an_episode(tmp_path: Path) -> None:
    dataset = Dataset(tmp_path / "set", describe(played("slide").config, ("forces",)))
    writer = RecordingWriter(dataset, dict.fromkeys(("source", "source_sha256", "span"), "x"))
    step_s = 1.0 / dataset.info["fps"]
    writer.add(0, 0.0, {})  # before any episode
    writer.begin_episode("a")
    times_ns = (0, -(10**9), 0, 0, 0)  # the clock is set back
    for t_ns, board_s in zip(times_ns, (1.0, 1.0 + step_s, 1.0 + 4.0 * step_s, 82.0, 0.5), strict=True):
        writer.add(t_ns, board_s, {})
    writer.begin_episode(None)
    writer.add(0, 0.6, {})
    assert writer.finish() == {"episodes": 3, "frames": 5 + 1 + 1}
    dataset.release()
    assert [row["length"] for row in rows(tmp_path / "set", "meta/episodes")] == [5, 1, 1]


def test_a_mark_begins_an_episode_and_the_mark_end_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = RecordingReplay.moments

    def marked(replaying: RecordingReplay) -> Any:
        for number, moment in enumerate(whole(replaying)):
            if number in (50, 80):
                yield Moment(moment.now, mark="slip" if number == 50 else "end")
            yield moment

    monkeypatch.setattr(RecordingReplay, "moments", marked)
    assert dataset(tmp_path / "set", recording("slide")) == 0
    (episode,) = rows(tmp_path / "set", "meta/episodes")
    assert (episode["tasks"], 0 < episode["length"] <= 31) == (["slip"], True)


@pytest.mark.lerobot
@pytest.mark.parametrize("cases", [("touches", "lost-bytes"), ("skin",)])
def test_lerobot_reads_every_frame(cases: tuple[str, ...], tmp_path: Path) -> None:
    assert dataset(tmp_path / "set", *map(recording, cases)) == 0
    command = [PYTHON, Path(__file__).with_name("lerobot_reader.py"), tmp_path / "set"]
    offline = os.environ | {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path)}
    found = json.loads(subprocess.run(command, env=offline, check=True, stdout=subprocess.PIPE).stdout)
    frames, episodes = rows(tmp_path / "set", "data"), rows(tmp_path / "set", "meta/episodes")
    assert found["tasks"] == [episodes[frame["episode_index"]]["tasks"][0] for frame in frames]
    for key, column in found["columns"].items():
        np.testing.assert_array_equal(np.ravel(column), np.ravel([frame[key] for frame in frames]))
    times = [frame["t_ns"] for frame in frames]
    spans = [range(row["dataset_from_index"], row["dataset_to_index"]) for row in episodes]
    assert found["previous"] == [[[times[max(n - 1, span[0])], times[n]] for n in span] for span in spans]
