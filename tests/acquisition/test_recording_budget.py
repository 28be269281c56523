"""Which files count for the budget of a daemon's recordings, and which give way."""

from pathlib import Path
from random import Random

import pytest
from recording_bench import PLATE, at

from resonator_daemon.acquisition.recording import Recorder
from resonator_daemon.acquisition.recording_budget import Room, Series
from resonator_daemon.acquisition.recording_file import Origin
from resonator_daemon.acquisition.wire_events import Received

LEFT = Origin(PLATE, "tcp://board:1", name="left")


def recorded(directory: Path, minute: int, says: str = "left") -> Path:
    """A recording of 20 kB with the name of this daemon, and a name inside."""
    path = Series(directory, "left").path((1_700_000_000 + 60 * minute) * 10**9)
    with Recorder(path, Origin(PLATE, "tcp://board:1", name=says)) as recorder:
        recorder.put(Received(at(0), Random(minute).randbytes(20_000)))
    return path


def test_the_file_before_counts_once_the_next_has_begun(tmp_path: Path) -> None:
    series = Series(tmp_path, "left", budget_bytes=75_000)
    room = Room(series, lambda *_: None)
    files = []
    for number in range(2):
        room.begin()
        file = series.make(LEFT, (1_800_000_000 + number) * 10**9)
        file.write(Received(at(0), Random(number).randbytes(50_000)))
        file.flush()
        room.keep_budget(file)
        file.finish()
        file.sync()
        files.append(file.path)
    assert [path.exists() for path in files] == [False, True]
    assert room.files_removed == 1


def test_a_recording_of_another_daemon_with_this_name_before_its_time_stays(tmp_path: Path) -> None:
    theirs = recorded(tmp_path, 0, says="right")
    room = Room(Series(tmp_path, "left", budget_bytes=1), lambda *_: None)
    own = Series(tmp_path, "left").make(LEFT, 1_800_000_000 * 10**9)
    room.keep_budget(own)
    assert theirs.exists()
    assert room.files_removed == 0
    own.abandon()


def test_recordings_that_somebody_else_removes_meanwhile_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = [recorded(tmp_path, minute) for minute in range(2)]
    room = Room(Series(tmp_path, "left", budget_bytes=75_000), lambda *_: None)
    own = Series(tmp_path, "left").make(LEFT, 1_800_000_000 * 10**9)
    listed = Series.files

    def files(series: Series) -> list[Path]:
        paths = listed(series)
        old[0].unlink(missing_ok=True)
        return paths

    monkeypatch.setattr(Series, "files", files)
    room.keep_budget(own)
    assert old[1].exists()
    assert room.files_removed == 0
    own.abandon()
