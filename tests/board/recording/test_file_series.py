"""Which files count for the budget of a daemon's recordings, and which give way."""

import fcntl
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from recording_bench import PLATE, made

from resonator_daemon.board.recording import file_series as recording_budget
from resonator_daemon.board.recording.file_series import DiskSpace, NoRoomError, Series
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.writer import RecordingWriter

LEFT = Origin(PLATE, "tcp://board:1", name="left")


@pytest.fixture
def own(tmp_path: Path) -> Iterator[RecordingWriter]:
    """The recording that is being written."""
    writer = Series(tmp_path, "left").make(LEFT, 1_800_000_000 * 10**9)
    yield writer
    writer.abandon()


def test_recordings_that_somebody_else_removes_meanwhile_are_left_out(
    tmp_path: Path, own: RecordingWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = [made(tmp_path, minute) for minute in range(2)]
    room = DiskSpace(Series(tmp_path, "left", max_total_bytes=75_000), lambda *_: None)
    listed = Series.files

    def files(series: Series) -> list[Path]:
        paths = listed(series)
        old[0].unlink(missing_ok=True)
        return paths

    monkeypatch.setattr(Series, "files", files)
    room.remove_oldest(own)
    assert old[1].exists()
    assert room.files_removed == 0


def test_the_oldest_recordings_of_this_name_make_room(tmp_path: Path, own: RecordingWriter) -> None:
    said: list[tuple[int, str]] = []
    old = [made(tmp_path, minute) for minute in range(4)]
    other = made(tmp_path, 0, "left-index")
    foreign = Series(tmp_path, "left").path(0)
    foreign.write_bytes(bytes(20_000))  # of this name, and no recording
    notes = tmp_path / "left-notes.mcap"
    notes.write_bytes(bytes(20_000))
    (tmp_path / "left-20200101T000000.000Z.mcap").symlink_to(other)
    room = DiskSpace(Series(tmp_path, "left", max_total_bytes=55_000), lambda *line: said.append(line))
    room.remove_oldest(own)
    assert [path.exists() for path in old] == [False, False, True, True]  # what is foreign does not count
    assert all(path.exists() for path in (other, foreign, notes, own.path))
    assert room.files_removed == 2
    assert said == [(logging.INFO, f"{path} was removed: recordings exceeded 0.055 MB") for path in old[:2]]


def test_a_recording_that_another_program_writes_is_not_removed(tmp_path: Path, own: RecordingWriter) -> None:
    old = [made(tmp_path, minute) for minute in range(2)]
    room = DiskSpace(Series(tmp_path, "left", max_total_bytes=25_000), lambda *_: None)
    with old[0].open("rb") as written:
        fcntl.flock(written, fcntl.LOCK_EX)
        room.remove_oldest(own)
    assert [path.exists() for path in old] == [True, False]


def test_a_failed_removal_is_logged_once(tmp_path: Path, own: RecordingWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[tuple[int, str]] = []
    old = made(tmp_path, 0)

    def refuse(path: Path) -> None:
        raise PermissionError(1, "Operation not permitted", str(path))

    monkeypatch.setattr(os, "unlink", refuse)
    room = DiskSpace(Series(tmp_path, "left", max_total_bytes=1), lambda *line: said.append(line))
    for _ in range(3):
        room.begin()
        room.remove_oldest(own)
    assert said == [(logging.WARNING, f"{old} cannot be removed: Operation not permitted")]
    assert room.files_removed == 0


def test_room_must_be_left_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording_budget.shutil, "disk_usage", lambda _: SimpleNamespace(free=480_000_000))
    room = DiskSpace(Series(tmp_path / "deep" / "er", "left", min_free_bytes=450_000_000), lambda *_: None)
    room.check(again=False)
    with pytest.raises(NoRoomError, match="480 MB left"):
        room.check(again=True)
