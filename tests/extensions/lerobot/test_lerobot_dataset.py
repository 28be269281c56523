"""Datasets for LeRobot: each value against the Parquet export, masks, episodes, interruption and mistakes."""

import json
import os
import signal
import subprocess
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from export_bench import recording

from resonator_daemon.commands import main
from resonator_daemon.tools.replay.recorded_pipeline import RecordingReplay

PYTHON = Path(__file__).parents[3] / "build" / "lerobot" / "bin" / "python"


def export(*words: object) -> int:
    return main(["export", *map(str, words)])


def dataset(folder: Path, *words: object) -> int:
    return export(*words, "--output", folder, "--format", "lerobot")


def rows(folder: Path, part: str) -> list[dict[str, Any]]:
    files = sorted((folder / part).glob("*/*.parquet"))
    return [row for file in files for row in pq.read_table(file).to_pylist()]


def same(found: Any, expected: Any) -> None:
    np.testing.assert_array_equal(np.ravel(found), np.ravel(expected).astype(np.float32))


@pytest.mark.parametrize("case", ["slide", "overload", "lost-bytes", "comb", "skin"])
def test_each_value_is_that_of_the_tables_and_the_rest_is_masked(case: str, tmp_path: Path) -> None:
    assert (
        dataset(tmp_path / "set", recording(case)) == export(recording(case), "--output", tmp_path / "t.parquet") == 0
    )
    tables: dict[str, dict[int, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    for topic in ("forces", "signals", "decoded", "contacts"):
        if (file := tmp_path / f"t-{topic}.parquet").exists():
            for row in pq.read_table(file).to_pylist():
                tables[topic][row["t_ns"]].append(row)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    readings = sorted(tables["forces"] or tables["signals"])
    frames = rows(tmp_path / "set", "data")
    assert len(frames) == info["total_frames"] == round((readings[-1] - readings[0]) * 1e-9 * info["fps"]) + 1
    assert [frame["t_ns"] for frame in frames if frame["t_ns"] in readings] == readings
    assert (case == "lost-bytes") == (len(frames) > len(readings))
    for number, frame in enumerate(frames):
        assert frame["frame_index"] == frame["index"] == number
        assert frame["timestamp"] == np.float32(number / info["fps"])
        found = {key.removeprefix("observation.tactile."): value for key, value in frame.items()}
        of = {topic: tables[topic].get(frame["t_ns"], []) for topic in tables}
        if "force" in found:
            names = info["features"]["observation.tactile.force"]["names"]
            first = of["forces"][0] if of["forces"] else {"status": "lost"}
            listed = [first.get(f"{name}_force_newton") for name in names]
            same(found["force"], [(0 if first["status"] == "ok" else np.nan) if f is None else f for f in listed])
            assert found["valid"] == bool(np.isfinite(found["force"]).all())
        for topic, key in (("signals", "signals"), ("decoded", "traction_pascal")):
            if topic in tables:
                name = key.removesuffix("_pascal")
                same(found[name], of[topic][0][key] if of[topic] else np.full(np.size(found[name]), np.nan))
        if case == "skin":
            assert found["valid"] == bool(of["decoded"])
        touching = [row for row in of["contacts"] if row["contact_id"] is not None]
        largest = max(touching, key=lambda row: row["contact_force_z_newton"], default=defaultdict(lambda: np.nan))
        at_rest = bool(of["contacts"]) and of["contacts"][0]["status"] == "ok" and not touching
        axes = "xyz" if case == "skin" else "z"
        force = [0.0 if at_rest else largest[f"contact_force_{axis}_newton"] for axis in axes]
        same(found["contact.force"], force)
        if not np.isnan(force).any():
            same(found["contact.position"], [largest["contact_position_x_m"], largest["contact_position_y_m"]])
        if case == "skin":
            same(found["contact.slip_margin"], [largest["contact_slip_margin"]])


def test_an_interrupted_export_is_completed_by_repeating_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    both = [recording("touches"), recording("lost-bytes")]  # the first has the mark "half time"
    assert dataset(tmp_path / "whole", *both) == 0
    whole = RecordingReplay.moments

    def interrupted(replaying: RecordingReplay) -> Any:
        for number, moment in enumerate(whole(replaying)):
            if number == 100 and (tmp_path / "set/data/chunk-000/file-000.parquet").exists():
                signal.raise_signal(signal.SIGINT)
            yield moment

    capsys.readouterr()
    with monkeypatch.context() as patched:
        patched.setattr(RecordingReplay, "moments", interrupted)
        assert dataset(tmp_path / "set", *both) == 1
    assert "complete recordings are kept; repeat the command" in capsys.readouterr().err
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["total_episodes"] == 1
    (tmp_path / "set/data/chunk-000/file-001.parquet.part").write_text("left by a killed export")
    assert dataset(tmp_path / "set", *both) == dataset(tmp_path / "set", *both) == 0
    files = [path.relative_to(tmp_path / "set") for path in (tmp_path / "set").rglob("*.*")]
    assert len(files) == 7
    assert [
        path for path in files if (tmp_path / "set" / path).read_bytes() != (tmp_path / "whole" / path).read_bytes()
    ] == []
    episodes, frames = rows(tmp_path / "set", "meta/episodes"), rows(tmp_path / "set", "data")
    assert [row["tasks"] for row in episodes] == [["half time"], ["recording"]]
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in episodes] == [(0, 106), (106, len(frames))]
    assert [frame["task_index"] for frame in frames] == [frame["episode_index"] for frame in frames]
    statistics = json.loads((tmp_path / "set/meta/stats.json").read_text())["observation.tactile.force"]
    force = np.array([frame["observation.tactile.force"] for frame in frames])
    for name, of_known in (("min", np.nanmin), ("max", np.nanmax), ("mean", np.nanmean), ("std", np.nanstd)):
        np.testing.assert_allclose(statistics[name], of_known(force, axis=0), rtol=1e-6)


def test_mistakes_are_one_message_and_change_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    (tmp_path / "faster.toml").write_text("")
    assert dataset(tmp_path / "set", recording("slide")) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    for code, words in (
        (78, (tmp_path / "mine", recording("slide"))),
        (78, (tmp_path / "mine" / "notes.txt", recording("slide"))),
        (2, (tmp_path / "set", recording("skin"))),
        (2, (tmp_path / "set", recording("touches"), "--topics", "forces")),
        (2, (tmp_path / "new", recording("slide"), recording("skin"))),
        (1, (tmp_path / "none", recording("refused"))),
    ):
        capsys.readouterr()
        assert dataset(*words) == code
    after = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    assert before.items() <= after.items()


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
