"""Recordings: every event comes back exactly, from whole, cut and damaged files, and no disk holds up who records."""

import errno
import os
import threading
import time
from pathlib import Path
from random import Random

import pytest
from mcap.writer import Writer
from plates import with_counter
from recording_bench import ONE_BATCH, PLATE, at, read, record
from small_disk import file_size_limit
from wire_host import wait_for

from resonator_daemon.base.plate import load_plate
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.recording import writer as recording_writer
from resonator_daemon.board.recording.reader import Origin, open_recording
from resonator_daemon.board.recording.recorder import Recorder, RecorderTimes
from resonator_daemon.board.session import link_events as wire
from resonator_daemon.board.session.clock import HostTime

EVENTS: list[wire.WireEvent] = [
    wire.StateAnnounced(at(0), Condition.STARTING, Reason(ReasonCode.OPENING, "the link is being opened")),
    wire.StateAnnounced(at(1), Condition.WAITING, Reason(ReasonCode.NO_SUCH_PORT, "/dev/ttyÿ: no such file — yet")),
    wire.Opened(at(2)),
    wire.Sent(at(3), b"\x01\0"),
    wire.Received(HostTime(at(4).monotonic_ns, -(10**9), -(2**62)), bytes(range(256))),
    wire.Received(at(5), b""),
    wire.TimersRun(at(5), idle=False),
    wire.TimersRun(at(6), idle=True),
    wire.Overrun(at(7)),
    wire.StopRequested(at(8)),
    wire.Lost(at(9), Reason(ReasonCode.UNPLUGGED, "unplugged (hung up)")),
    wire.Refused(
        at(10), (Reason(ReasonCode.WRONG_PLATE, "one"), Reason(ReasonCode.WRONG_GATE, "two")), other_protocol=True
    ),
    wire.Refused(at(10), (), other_protocol=False),
    wire.Closed(at(11)),
    wire.Skipped(at(12), 3, 400),
]
DEADLINE_S = 30.0


def test_every_event_comes_back_exactly(path: Path) -> None:
    recorder = record(path, EVENTS)
    events, damage = read(path)
    assert events == EVENTS
    assert list(map(type, events)) == list(map(type, EVENTS))  # named tuples of two kinds can be equal
    assert damage is None
    assert (recorder.counts.events_missing, recorder.failure) == (0, None)


def test_what_does_not_fit_into_the_queue_is_counted_in_its_place(path: Path) -> None:
    large = wire.Received(at(2), bytes(10_000))
    events = [wire.Opened(at(1)), large, large, wire.Closed(at(3)), large]
    recorder = record(path, events, queue_bytes=5_000)
    kept, _ = read(path)
    *first, last = kept
    assert first == [wire.Opened(at(1)), wire.Skipped(at(3), 2, 20_000), wire.Closed(at(3))]
    assert (type(last), last[1:]) == (wire.Skipped, (1, 10_000))
    assert recorder.counts.events_missing == 3


def test_a_disk_without_room_ends_the_recording_and_not_the_reader(path: Path) -> None:
    random = Random(1)
    deadline = time.monotonic() + DEADLINE_S
    put = 0
    with file_size_limit(2_000_000), Recorder(path, Origin(PLATE, "tcp://board:1")) as recorder:
        while recorder.failure is None:
            assert time.monotonic() < deadline
            recorder.put(wire.Received(at(put), random.randbytes(100_000)))
            put += 1
            threading.Event().wait(0.005)
        recorder.put(wire.Closed(at(put)))
    assert recorder.failure.code == "write_failed"
    events, damage = read(path)
    assert damage == "cut off"
    assert [event.now for event in events] == [at(number) for number in range(len(events))]
    assert 10 < len(events) < 20
    assert recorder.counts.events_missing >= 1


def test_whatever_else_goes_wrong_ends_the_recording_and_is_said(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(event: wire.WireEvent) -> bytes:
        if isinstance(event, wire.Sent):
            raise RuntimeError("LZ4 has no memory")
        return wire.encode(event)

    monkeypatch.setattr(recording_writer, "encode", broken)
    recorder = record(path, [wire.Opened(at(0)), wire.Sent(at(1), b"x")])
    assert recorder.failure.code == "write_failed"
    assert recorder.written.events == 0
    assert recorder.counts.events_missing == 2  # the other waited for its chunk to be full
    recorder.put(wire.Closed(at(2)))
    assert recorder.counts.events_missing == 3


def test_whole_chunks_count_as_written_where_the_end_fails(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(recording_writer.Writer, "finish", full)
    written: list[wire.WireEvent] = [wire.Opened(at(0)), wire.Received(at(1), b"x"), wire.Closed(at(2))]
    with Recorder(path, Origin(PLATE, "tcp://board:1"), times=RecorderTimes(flush_s=3600.0)) as recorder:
        recorder.put(written[0])
        wait_for(lambda: recorder.written.events > 0)  # flushed once
        for event in written[1:]:
            recorder.put(event)
    assert recorder.failure.code == "disk_full"
    assert read(path)[0] == written
    assert (recorder.written.events, recorder.counts.events_missing) == (3, 0)
    assert recorder.all_bytes == path.stat().st_size


def test_damage_ends_a_recording_where_it_is_found(path: Path) -> None:
    random = Random(3)
    written: list[wire.WireEvent] = [wire.Received(at(number), random.randbytes(60_000)) for number in range(30)]
    record(path, written, times=ONE_BATCH)
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2] ^= 4
    path.write_bytes(whole)
    events, damage = read(path)
    assert 0 < len(events) < 30
    assert events == written[: len(events)]
    assert damage.startswith("damaged before byte ")


def test_no_bit_that_flips_is_taken_for_an_event(path: Path) -> None:
    record(path, EVENTS)
    whole = path.read_bytes()
    random = Random(4)
    for _ in range(300):
        bent = bytearray(whole)
        bent[random.randrange(len(bent))] ^= 1 << random.randrange(8)
        path.write_bytes(bent)
        try:
            events, _ = read(path)
        except LinkUnavailableError:
            continue
        assert events == EVENTS[: len(events)]


def test_what_is_no_recording_is_said(tmp_path: Path) -> None:
    path = tmp_path / "file"
    for content in (b"", Random(5).randbytes(5000)):
        path.write_bytes(content)
        for place, said in ((path, "is no recording"), (tmp_path, "is no regular file")):
            with pytest.raises(LinkUnavailableError, match=said):
                open_recording(str(place), PLATE)
    for profile, name, metadata, said in (
        ("ros2", "recording", {"format": "1"}, "is an MCAP file, but no recording"),
        ("resonatord", "other", {"format": "1"}, "does not contain the description"),
        ("resonatord", "recording", {"format": "9"}, "has format 9, this version reads format 2"),
        ("resonatord", "recording", {"format": "1"}, "has format 1, this version reads format 2"),
    ):
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start(profile)
            writer.add_metadata(name, metadata)
            writer.finish()
        with pytest.raises(LinkUnavailableError, match=said):
            open_recording(str(path), PLATE)


def test_a_recording_of_another_plate_is_refused(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    record(path, EVENTS)
    with pytest.raises(LinkUnavailableError, match="of plate 'quartz16', the configuration names plate 'skin32'"):
        open_recording(str(path), load_plate("skin32"))
    slower = with_counter(PLATE, frame_rate_hz=500.0)
    with pytest.raises(LinkUnavailableError, match=r"another \[counter\] or other tones than plate 'quartz16' has now"):
        open_recording(str(path), slower)
    assert caplog.messages == []
    heavier = PLATE.model_copy(update={"force_max_newton": 7.0})
    events, _ = read(path, heavier)
    assert events == EVENTS
    assert ["has changed since" in message for message in caplog.messages] == [True]
