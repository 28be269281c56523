"""Recordings switched on and off while a board is read: what a replay of each gives, and what is said of it."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from connection_bench import DESCRIPTION, IDENTITY
from emulation import emulated
from listener import DEADLINE_S, Listener, frames, gaps
from mcap.reader import make_reader
from recording_bench import PLATE, at, marks, read, replayed, same, snapshot

from firmware_protocol.messages import Configuration
from resonator_daemon.base.errors import UserError
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.recording import recorder as recording
from resonator_daemon.board.recording import switch as recording_switch
from resonator_daemon.board.recording.file_series import Series
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.recorder import Recorder
from resonator_daemon.board.recording.switch import NothingRecordedError, RecordingRunningError, RecordingSwitch
from resonator_daemon.board.recording.writer import Published
from resonator_daemon.board.session import link_events
from resonator_daemon.board.session.frames import BoardOnline, LinkChange
from simulators.emulator import EmulatorOptions
from simulators.faults import parse_faults

SCHEMA = {"title": "Count", "type": "object", "properties": {"count": {"type": "integer"}}}
ORIGIN = Origin(PLATE, "tcp://board:1")


@contextmanager
def listening(link: LinkTarget, plate: Plate = PLATE) -> Iterator[tuple[Listener, RecordingSwitch]]:
    switch = RecordingSwitch()
    with Listener(link, plate, on_event=switch.put) as it:
        yield it, switch
    it.take_the_rest()
    switch.stop()


def pseudo_terminal(port: Path, faults: str = "") -> tuple[EmulatorOptions, SerialTarget]:
    options = EmulatorOptions("quartz16", pty=port, faults=parse_faults(faults))
    return options, SerialTarget(str(port), 4000000)


def running_snapshot(folder: Path) -> link_events.SnapshotTaken:
    """How the link to a board stood while it was open."""
    snapshots: list[link_events.SnapshotTaken] = []
    options, link = pseudo_terminal(folder / "board")

    def collect(event: object) -> None:
        if isinstance(event, link_events.SnapshotTaken) and event.snapshot.running is not None:
            snapshots.append(event)

    with emulated(options), Listener(link, PLATE, on_event=collect) as it:
        it.wait_for_frames(100)
    return snapshots[-1]


def test_a_recording_begun_while_frames_come_is_replayed_with_their_numbers(path: Path, tmp_path: Path) -> None:
    options, link = pseudo_terminal(tmp_path / "board")
    with emulated(options), listening(link) as (it, switch):
        it.wait_for_frames(700)
        switch.start(path, Origin(PLATE, str(link)))
        began_with = frames(it.arrivals)[-1].index
        it.wait_for_frames(len(frames(it.arrivals)) + 1500)
        summary = switch.stop()
        it.take_the_rest()
    arrivals, counters, differences = replayed(path)
    again = frames(arrivals)
    by_index = {frame.index: frame for frame in frames(it.arrivals)}
    assert (differences, counters.frames, counters.lost.total) == (0, len(again), 0)
    assert [frame.index for frame in again] == [i for i in by_index if again[0].index <= i <= again[-1].index]
    assert all(same(frame, by_index[frame.index]) for frame in again)
    assert 300 < again[0].index <= began_with + 200  # what was kept begins about 100 ms before
    assert len(again) > 1200
    assert gaps(arrivals) == []
    change, online = arrivals[:2]
    assert isinstance(change, LinkChange)
    assert (change.state, change.reason.code) == ("online", "board_counts")
    assert isinstance(online, BoardOnline)
    assert online == next(arrival for arrival in it.arrivals if isinstance(arrival, BoardOnline))
    assert all(frame.gate_middle.uncertainty_ns < 10_000_000 for frame in again)
    events, damage = read(path)
    assert damage is None
    assert isinstance(events[0], link_events.SnapshotTaken)
    assert (summary.path, summary.all_bytes, summary.failure) == (path, path.stat().st_size, None)
    assert (summary.counts.files, summary.written.events, summary.counts.events_missing) == (1, len(events), 0)
    assert 1.0 < summary.seconds < DEADLINE_S


def test_one_recording_runs_at_a_time_and_no_file_is_overwritten(tmp_path: Path) -> None:
    switch = RecordingSwitch()
    with pytest.raises(NothingRecordedError):
        switch.mark("before")
    assert switch.current is None
    before_ns = time.time_ns()
    switch.start(tmp_path / "one.mcap", ORIGIN)
    with pytest.raises(RecordingRunningError):
        switch.start(tmp_path / "two.mcap", ORIGIN)
    assert not (tmp_path / "two.mcap").exists()
    now = switch.current
    assert (now.path, now.failure) == (tmp_path / "one.mcap", None)
    assert before_ns <= now.since.utc_ns <= time.time_ns()
    switch.stop()
    assert switch.current is None
    with pytest.raises(UserError, match=r"one\.mcap exists already, and nothing is overwritten"):
        switch.start(tmp_path / "one.mcap", ORIGIN)
    assert switch.current is None


def test_a_mark_is_a_line_of_text_at_its_time(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    switch = RecordingSwitch()
    switch.put(link_events.StateAnnounced(at(0), Condition.STARTING, Reason(ReasonCode.OPENING, "first")))
    switch.start(path, ORIGIN)
    times_ns = [switch.mark("the finger slips"), switch.mark("¼ N")]
    switch.put(link_events.StateAnnounced(at(1), Condition.WAITING, Reason(ReasonCode.NO_SUCH_PORT, "second")))
    summary = switch.stop()
    assert (summary.written.events, summary.counts.events_missing) == (2, 0)
    assert marks(path) == list(zip(times_ns, ["the finger slips", "¼ N"], strict=True))
    assert times_ns[0] <= times_ns[1] <= time.time_ns()
    arrivals, _, differences = replayed(path)
    assert differences == 0
    assert [arrival.reason.text for arrival in arrivals[:2]] == ["first", "second"]  # type: ignore[union-attr]
    assert f"{path}: mark: the finger slips" in caplog.messages


def test_the_switch_does_not_wait_for_a_slow_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    making, made = threading.Event(), threading.Event()

    def slowly(path: Path, origin: Origin, *, log_line: object) -> Recorder:
        making.set()
        assert made.wait(DEADLINE_S)
        return Recorder(path, origin)

    monkeypatch.setattr(recording_switch, "Recorder", slowly)
    switch = RecordingSwitch()
    starter = threading.Thread(target=switch.start, args=(tmp_path / "run.mcap", ORIGIN))
    starter.start()
    try:
        assert making.wait(DEADLINE_S)
        switch.put(link_events.Opened(at(0)))
        assert switch.current is None
    finally:
        made.set()
        starter.join()
    switch.stop()
    events, _ = read(tmp_path / "run.mcap")
    assert events == [link_events.Opened(at(0))]


def test_what_is_kept_is_bounded_and_a_recording_begins_with_the_next_standing(path: Path, tmp_path: Path) -> None:
    snapshot = running_snapshot(tmp_path)
    switch = RecordingSwitch(kept_bytes=15_500)
    for number in range(12):
        switch.put(link_events.Received(at(number), bytes(1_000)))
    switch.start(path, ORIGIN)
    switch.put(link_events.Received(at(5), bytes(7)))
    switch.put(snapshot)
    switch.put(link_events.TimersRun(at(6), idle=True))
    summary = switch.stop()
    assert (summary.written.events, summary.counts.events_missing) == (2, 1)
    events, _ = read(path)
    assert events == [link_events.Skipped(snapshot.now, 1, 7), snapshot, link_events.TimersRun(at(6), idle=True)]


def test_each_file_has_the_present_board_and_the_last_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "read_host_time", lambda: at(-1000))
    board = BoardOnline(IDENTITY, DESCRIPTION, 0xABC, Configuration(10**6), continues=False)
    there = running_snapshot(tmp_path)
    switch = RecordingSwitch()
    switch.publish(Published("state/link", 5, b'{"count":1}', SCHEMA, retained=True))
    switch.publish(Published("state/link", 6, b'{"count":2}', SCHEMA, retained=True))
    switch.publish(Published("forces", 6, b'{"count":0}', SCHEMA, retained=False))  # nothing is recorded yet
    switch.start(Series(tmp_path, "left", file_max_ns=1), ORIGIN)
    switch.publish(Published("forces", 7, b'{"count":3}', SCHEMA, retained=False))
    switch.name_board(board)
    for ms in range(2):
        switch.put(there._replace(now=at(ms)))
    switch.put(snapshot(at(2)))
    switch.stop()
    seen = []
    for path in Series(tmp_path, "left").files():
        with path.open("rb") as file:
            reader = make_reader(file)
            named = [item.metadata["serial_number"] for item in reader.iter_metadata() if item.name == "board"]
            told = [
                (channel.topic, schema.name, json.loads(schema.data), channel.message_encoding, message.log_time,
                 json.loads(message.data)["count"])
                for schema, channel, message in reader.iter_messages(topics=["state/link", "forces"])
                if schema is not None
            ]  # fmt: skip
        seen.append((named, sorted(told, key=str)))
    state = ("state/link", "Count", SCHEMA, "json", 6, 2)
    forces = ("forces", "Count", SCHEMA, "json", 7, 3)
    assert seen == [(["T-1"], [forces, state]), (["T-1"], [state]), ([], [state])]


def test_a_recording_goes_from_file_to_file_without_a_frame_twice_or_missing(tmp_path: Path) -> None:
    options, link = pseudo_terminal(tmp_path / "board", "unplug_at_s=1.2,unplug_for_s=0.3")
    series = Series(tmp_path / "recordings", "left", file_max_ns=400_000_000)
    with emulated(options), listening(link) as (it, switch):
        it.wait_for_frames(100)
        switch.start(series, Origin(PLATE, str(link)))
        it.wait_for(lambda arrivals: bool(gaps(arrivals)))
        it.wait_for_frames(len(frames(it.arrivals)) + 700)
        switch.stop()
        it.take_the_rest()
    by_index = {frame.index: frame for frame in frames(it.arrivals)}
    seen = []
    for path in series.files():
        arrivals, _, differences = replayed(path)
        assert differences == 0
        assert isinstance(read(path)[0][0], link_events.SnapshotTaken)
        seen += frames(arrivals)
    assert len(series.files()) >= 4
    assert all(same(frame, by_index[frame.index]) for frame in seen)
    assert [frame.index for frame in seen] == [index for index in by_index if seen[0].index <= index <= seen[-1].index]
    assert len(seen) > 1200
