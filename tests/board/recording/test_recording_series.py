"""A recording that goes from file to file: where each begins, what is removed for room, and a disk without any."""

import logging
import os
import shutil
from pathlib import Path
from random import Random
from types import SimpleNamespace

import pytest
from recording_bench import FLUSHING, NO_PAUSE, ONE_BATCH, PLATE, at, made, read, snapshot
from small_disk import file_size_limit
from wire_host import wait_for

from resonator_daemon.board.recording import file_series as recording_budget
from resonator_daemon.board.recording import recorder as recording
from resonator_daemon.board.recording.file_series import Series
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.recorder import Recorder
from resonator_daemon.board.recording.writer import Published
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.link_events import Opened, Received, SnapshotTaken, TimersRun, WireEvent

LEFT = Origin(PLATE, "tcp://board:1", name="left")
SCHEMA = {"title": "Count", "type": "object", "properties": {"count": {"type": "integer"}}}


@pytest.fixture(autouse=True)
def _begins_before_its_events(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "read_host_time", lambda: at(-1000))


def contents(directory: Path) -> list[list[WireEvent]]:
    files = Series(directory, "left").files()
    assert all(read(path)[1] is None for path in files)
    return [read(path)[0] for path in files]


def test_the_next_file_begins_with_the_standing_at_which_the_last_ended(tmp_path: Path) -> None:
    series = Series(tmp_path, "left", file_max_ns=1_000_000_000)
    with Recorder(series, LEFT, times=ONE_BATCH) as recorder:
        for ms in range(0, 3000, 100):
            recorder.put(snapshot(at(ms)))
            recorder.put(Received(at(ms), bytes([ms // 100])))
            recorder.put(TimersRun(at(ms + 1), idle=False))
    begun = [[event.now for event in events if isinstance(event, SnapshotTaken)] for events in contents(tmp_path)]
    assert begun == [[at(0)], [at(1000)], [at(2000)]]
    assert all(isinstance(events[0], SnapshotTaken) for events in contents(tmp_path))
    received = [event.data for events in contents(tmp_path) for event in events if isinstance(event, Received)]
    assert received == [bytes([number]) for number in range(30)]
    assert (recorder.written.events, recorder.counts.files, recorder.counts.events_missing) == (63, 3, 0)


def test_a_file_ends_once_it_is_large(tmp_path: Path) -> None:
    series = Series(tmp_path, "left", file_max_bytes=400_000)
    random = Random(1)
    with Recorder(series, LEFT) as recorder:
        for ms in range(0, 1000, 10):
            recorder.put(snapshot(at(ms)))
            recorder.put(Received(at(ms), random.randbytes(20_000)))
    sizes = [path.stat().st_size for path in series.files()]
    assert len(sizes) >= 3
    assert all(400_000 <= size < 400_000 + 300_000 + 50_000 for size in sizes[:-1])
    received = [event for events in contents(tmp_path) for event in events if isinstance(event, Received)]
    assert [event.now for event in received] == [at(ms) for ms in range(0, 1000, 10)]
    assert recorder.written.events == sum(map(len, contents(tmp_path)))
    assert recorder.all_bytes == sum(sizes)
    assert recorder.counts.file_bytes == sizes[-1]


def test_messages_give_way_to_the_link(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", LEFT, queue_bytes=10_000, times=ONE_BATCH) as recorder:
        for number in range(20):
            recorder.publish(Published("forces", number, b'{"count":0}', SCHEMA, retained=False))
        recorder.put(Received(at(0), bytes(4_000)))
    assert recorder.counts.events_missing == 0
    assert (recorder.counts.messages, recorder.counts.messages_missing) == (16, 4)


def test_a_recorder_keeps_the_budget_while_it_writes(tmp_path: Path) -> None:
    old = made(tmp_path, 0, size_bytes=50_000)
    with Recorder(Series(tmp_path, "left", max_total_bytes=60_000), LEFT, times=FLUSHING) as recorder:
        recorder.put(Received(at(0), b"x"))
        wait_for(lambda: recorder.written.events == 1)
        assert old.exists()
        recorder.put(Received(at(1), Random(1).randbytes(50_000)))
        wait_for(lambda: recorder.counts.files_removed == 1)
    assert not old.exists()


@pytest.mark.parametrize("resumes", [True, False])
def test_a_recording_ends_before_the_disk_is_full_and_resumes_where_it_may(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resumes: bool
) -> None:
    free_bytes = [200]
    monkeypatch.setattr(recording_budget.shutil, "disk_usage", lambda _: SimpleNamespace(free=free_bytes[-1]))
    said: list[tuple[int, str]] = []
    series = Series(tmp_path, "left", min_free_bytes=100, resumes=resumes)
    with Recorder(series, LEFT, log_line=lambda *line: said.append(line), times=FLUSHING) as recorder:
        recorder.put(Opened(at(0)))
        wait_for(lambda: recorder.written.events == 1)
        free_bytes.append(99)
        wait_for(lambda: recorder.failure is not None)
        assert recorder.failure.code == "disk_full"
        assert contents(tmp_path) == [[Opened(at(0))]]  # and it has its end
        free_bytes.append(109)  # not enough to begin anew
        for ms in (1, 2):
            recorder.put(snapshot(at(ms)))
            recorder.put(Received(at(ms), b"x"))
        wait_for(lambda: recorder.counts.events_missing == 2)
        assert recorder.failure is not None
        free_bytes.append(200)
        recorder.put(Received(at(3), b"x"))
        recorder.put(snapshot(at(4)))
        recorder.put(Received(at(4), b"y"))
        wait_for(lambda: recorder.written.events + recorder.counts.events_missing == (6 if resumes else 5))
    if resumes:
        assert recorder.failure is None
        assert contents(tmp_path)[1:] == [[snapshot(at(4)), Received(at(4), b"y")]]
        assert recorder.counts.events_missing == 3
        assert [level for level, _ in said] == [logging.WARNING, logging.INFO]
    else:
        assert len(contents(tmp_path)) == 1
        assert recorder.counts.events_missing == 4
        assert [level for level, _ in said] == [logging.WARNING]


def test_after_an_error_a_recording_goes_on_in_a_new_file(tmp_path: Path) -> None:
    with Recorder(Series(tmp_path, "left", resumes=True), LEFT, times=NO_PAUSE) as recorder:
        recorder.put(Opened(at(0)))
        wait_for(lambda: recorder.written.events == 1)
        opened = {os.path.realpath(file): int(file.name) for file in Path("/proc/self/fd").iterdir()}
        os.close(opened[str(recorder.path)])  # as a disk that was pulled out
        shutil.rmtree(tmp_path)
        recorder.put(Received(at(1), Random(1).randbytes(600_000)))
        wait_for(lambda: recorder.failure is not None)
        recorder.put(snapshot(at(2)))
        wait_for(lambda: recorder.failure is None)
    assert contents(tmp_path) == [[snapshot(at(2))]]


@pytest.mark.parametrize("needs_frame", [False, True])
def test_an_attempt_without_an_event_or_frame_leaves_no_file(tmp_path: Path, *, needs_frame: bool) -> None:
    said: list[int] = []
    series = Series(tmp_path, "left", resumes=True)
    with (
        file_size_limit(10_000),  # room for its beginning
        Recorder(
            series, LEFT, log_line=lambda level, _: said.append(level), times=NO_PAUSE, needs_frame=needs_frame
        ) as recorder,
    ):
        for ms in range(3):
            recorder.put(snapshot(at(ms)))
            if needs_frame:
                wait_for(lambda: recorder.written.events == 1)
            recorder.put(Received(at(ms), Random(ms).randbytes(600_000)))
            wait_for(lambda ms=ms: recorder.counts.events_missing == ms + 1)  # type: ignore[misc]
            assert list(tmp_path.iterdir()) == []
            assert (recorder.counts.files, recorder.all_bytes, recorder.path) == (0, 0, tmp_path)
            assert (recorder.written.events, recorder.written.frames) == (0, 0)
    assert said == [logging.WARNING]


@pytest.mark.parametrize("how", ["removed", "moved", "replaced"])
def test_a_file_that_nobody_finds_any_more_is_said_once_and_another_begun(tmp_path: Path, how: str) -> None:
    said: list[tuple[int, str]] = []
    directory = tmp_path / "recordings"
    with Recorder(Series(directory, "left", resumes=True), LEFT, log_line=lambda *line: said.append(line)) as recorder:
        recorder.put(snapshot(at(0)))
        wait_for(lambda: recorder.written.events == 1)
        first = recorder.path
        if how == "removed":
            shutil.rmtree(directory)
        else:
            directory.rename(tmp_path / "elsewhere")
        if how == "replaced":
            directory.mkdir()
            first.write_bytes(b"theirs")
        wait_for(lambda: recorder.failure is not None and recorder.failure.code == "file_gone")
        recorder.put(snapshot(at(1)))
        wait_for(lambda: recorder.failure is None)
        second = recorder.path
        recorder.put(Opened(at(2)))
    assert read(second) == ([snapshot(at(1)), Opened(at(2))], None)
    if how == "moved":
        assert read(tmp_path / "elsewhere" / first.name) == ([snapshot(at(0))], None)
    if how == "replaced":
        assert first.read_bytes() == b"theirs"
    assert [level for level, _ in said] == [logging.WARNING, logging.INFO]
    assert [str(path) in text for path, (_, text) in zip((first, second), said, strict=True)] == [True, True]


def test_names_stay_in_order_where_the_clock_is_set_back(tmp_path: Path) -> None:
    back_ns = at(0).utc_less_monotonic_ns - 10**15
    begun = [at(0), HostTime(2 * 10**9, back_ns, 0), HostTime(3 * 10**9, back_ns, 0)]
    with Recorder(Series(tmp_path, "left", file_max_ns=1), LEFT) as recorder:
        for now in begun:
            recorder.put(snapshot(now))
    assert [events[0].now for events in contents(tmp_path)] == begun
