"""`resonatord repair`: what is whole of a recording is copied, what is not is said, and the original stays."""

import fcntl
import json
import os
import signal
from collections import Counter
from pathlib import Path
from random import Random

import pytest
from mcap.reader import make_reader
from recording_bench import ONE_BATCH

from resonator_daemon.base.host.files import NoNewFileError
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.recording import recorder as recording
from resonator_daemon.board.recording.reader import READ_ERRORS, Mark, Origin, open_recording
from resonator_daemon.board.recording.recorder import Recorder
from resonator_daemon.board.recording.repair import RepairError, repair
from resonator_daemon.board.recording.writer import Published, RecordingWriter
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.link_events import Closed, Received, Skipped, WireEvent
from resonator_daemon.commands import main

ORIGIN = Origin(load_plate("quartz16"), "tcp://board:1", name="left", plate_text="a = 1\n", settings_text="b = 2\n")
SKIPPED = 10  # kind of an event
DATA_END = b"\x0f\x04" + bytes(7)
SCHEMA = {"title": "Count", "type": "object"}


def at(ms: int) -> HostTime:
    return HostTime(10**9 + ms * 10**6, 1_789_000_000 * 10**9, 0)


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, list[WireEvent]]:
    """A whole recording of some chunks, and its events."""
    monkeypatch.setattr(recording, "TIMES", ONE_BATCH)  # so that the same is in each chunk
    random = Random(1)
    path = tmp_path / "run.mcap"
    events: list[WireEvent] = [Received(at(ms), random.randbytes(60_000)) for ms in range(30)]
    with Recorder(path, ORIGIN) as recorder:
        recorder.mark(Mark(at(0), "begun"))
        recorder.publish(Published("forces", 5, b'{"count":1}', SCHEMA, retained=False))
        for event in [*events, Closed(at(30))]:
            recorder.put(event)
    return path, [*events, Closed(at(30))]


def read(path: Path) -> tuple[list[WireEvent], str | None]:
    with open_recording(str(path), ORIGIN.plate) as it:
        return list(it.events()), it.damage


def chunks(path: Path) -> list[tuple[int, int]]:
    """Where chunks begin, and their sizes."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    return [(chunk.chunk_start_offset, chunk.chunk_length) for chunk in summary.chunk_indexes]


def content(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Topic, times and data of all messages in the order of the file, as any reader of such files finds them."""
    with path.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [
            (channel.topic, message.log_time, message.publish_time, message.data) for _, channel, message in messages
        ]


def test_wherever_a_file_is_cut_it_can_be_mended(made: tuple[Path, list[WireEvent]], tmp_path: Path) -> None:
    path, written = made
    whole = path.read_bytes()
    first, _ = chunks(path)[0]
    copy = tmp_path / "copy.mcap"
    for cut in (first, first + 1, len(whole) - 1, *Random(2).sample(range(first, len(whole)), 30)):
        path.write_bytes(whole[:cut])
        before = read(path)[0]
        if not before:
            with pytest.raises(RepairError, match="has no event that can be read; no copy is made"):
                repair(path, copy)
            continue
        done = repair(path, copy)
        assert read(copy) == (before, None)
        assert before == written[: done.events]
        assert done.ended == done.index_damaged == (cut > whole.rindex(DATA_END))
        assert done.cut_bytes <= cut - first
        copy.unlink()


@pytest.mark.parametrize(("number", "has_index"), [(0, True), (2, True), (-1, True), (-1, False)])
def test_a_damaged_chunk_is_left_out_and_told_in_its_place(
    made: tuple[Path, list[WireEvent]], tmp_path: Path, number: int, *, has_index: bool
) -> None:
    path, written = made
    begin, size = chunks(path)[number]
    bent = bytearray(path.read_bytes())
    bent[begin + size // 2] ^= 4
    path.write_bytes(bent if has_index else bent[: bent.rindex(DATA_END)])
    assert read(path)[1] is not None
    copy = tmp_path / "copy.mcap"
    done = repair(path, copy)
    events, damage = read(copy)
    assert damage is None
    assert (done.damaged_parts, done.cut_bytes) == (1, 0)
    assert done.events + done.events_missing == len(written)
    assert 1 <= done.events_missing <= 6
    (word,) = [event for event in events if isinstance(event, Skipped)]
    place = events.index(word)
    assert events[:place] + events[place + 1 :] == written[:place] + written[place + word.events :]
    beside = events[place + 1 if number >= 0 else place - 1]
    assert (word.events, word.now) == (done.events_missing, beside.now)
    again = repair(copy, tmp_path / "again.mcap")
    assert (again.was_whole, again.events_missing_before) == (True, done.events_missing)


@pytest.mark.parametrize("has_index", [True, False])
@pytest.mark.parametrize(
    ("chunk_count", "size_bytes", "first", "step"),
    [(3, 1, 0, 3), *(pytest.param(11, 2600, first, 10, marks=pytest.mark.soak) for first in range(10))],  # 4 kB, 64 kB
)
def test_a_flipped_bit_costs_its_chunk_at_most(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    chunk_count: int,
    size_bytes: int,
    first: int,
    step: int,
    *,
    has_index: bool,
) -> None:
    monkeypatch.setattr("resonator_daemon.base.host.files.os.fsync", lambda _: None)
    path, copy = tmp_path / "run.mcap", tmp_path / "copy.mcap"
    random = Random(3)
    writer = RecordingWriter(path, ORIGIN, 0)
    for number in range(chunk_count):
        for ms in range(20 * number, 20 * number + 2):
            writer.write(Received(at(ms), random.randbytes(size_bytes)))
        writer.mark(Mark(at(20 * number), f"mark {number}"))
        writer.publish(Published("forces", number, b'{"count":1}', SCHEMA, retained=False))
        writer.flush()
    writer.finish()
    writer.close()
    header, written, parts = ORIGIN.metadata, content(path), chunks(path)
    whole = path.read_bytes()
    end = len(whole) if has_index else whole.rindex(DATA_END)
    os.truncate(path, end)
    for place in range(first, end, step):
        with path.open("r+b") as file:
            file.seek(place)
            file.write(bytes([whole[place] ^ 1 << place % 8]))
            file.seek(place)
            file.flush()
            done = repair(path, copy)
            file.write(whole[place : place + 1])
        with open_recording(str(copy)) as recording:
            assert recording.header == header
        recovered = [message for message in content(copy) if message[0] != "wire" or message[3][0] != SKIPPED]
        hit = [number for number, (begin, length) in enumerate(parts) if begin <= place < begin + length]
        expected = [message for number, message in enumerate(written) if number // 4 not in hit]
        assert recovered in (expected, written), place
        assert done.ended == has_index
        counts = Counter(message[0] for message in recovered)
        assert done.recovered == counts
        assert counts + Counter(done.missing) == Counter(message[0] for message in written)
        copy.unlink()


def test_what_cannot_be_repaired_is_said(made: tuple[Path, list[WireEvent]], tmp_path: Path) -> None:
    path, _ = made
    with pytest.raises(RepairError, match="No such file"):
        repair(tmp_path / "none.mcap", tmp_path / "copy.mcap")
    with pytest.raises(RepairError, match="is no regular file"):
        repair(tmp_path, tmp_path / "copy.mcap")
    (tmp_path / "text").write_text("Dear diary" * 100)
    with pytest.raises(
        RepairError,
        match="is no recording, or nothing of it was written; name a file that `resonatord record` has written",
    ):
        repair(tmp_path / "text", tmp_path / "copy.mcap")
    with pytest.raises(NoNewFileError, match="cannot be written: No such file or directory"):
        repair(path, tmp_path / "none" / "copy.mcap")
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(RepairError, match="is being written; stop that first"):
            repair(path, tmp_path / "copy.mcap")
    assert not (tmp_path / "copy.mcap").exists()


@pytest.mark.parametrize("part", ["place of a chunk", "begin of the index", "begin of its offsets", "end"])
def test_a_damaged_index_is_made_anew(
    made: tuple[Path, list[WireEvent]], tmp_path: Path, capsys: pytest.CaptureFixture[str], part: str
) -> None:
    path, written = made
    begin, _ = chunks(path)[2]
    whole = content(path)
    bent = bytearray(path.read_bytes())
    footer = len(bent) - 8 - 29 + 9  # behind its own opcode and length
    if part == "place of a chunk":
        bent[bent.rindex(begin.to_bytes(8, "little"))] ^= 64
    elif part == "begin of the index":
        bent[footer] += 5
    elif part == "begin of its offsets":
        bent[footer + 8] += 5
    else:
        bent += bytes(512)
    path.write_bytes(bent)
    if part != "begin of its offsets":  # which this reader does not look at
        with pytest.raises(READ_ERRORS):
            content(path)
    assert read(path) == (written, None)
    copy = tmp_path / "copy.mcap"
    assert main(["repair", str(path), "--output", str(copy), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["index_damaged"]
    assert err.startswith(f"{path}: its index is damaged; {copy} has {len(written)} events up to ")
    assert content(copy) == whole
    with open_recording(str(copy)) as it:
        assert (it.header["name"], it.plate_text, it.settings_text) == ("left", "a = 1\n", "b = 2\n")
    assert repair(copy, tmp_path / "again.mcap").was_whole


def test_a_repair_that_is_interrupted_leaves_nothing(
    made: tuple[Path, list[WireEvent]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_: int) -> None:
        signal.raise_signal(signal.SIGTERM)

    path, _ = made
    path.write_bytes(path.read_bytes()[:-1])
    monkeypatch.setattr("resonator_daemon.base.host.files.os.fsync", interrupted)
    assert main(["repair", str(path)]) == 1
    assert capsys.readouterr().err == "resonatord: interrupted: no copy is made\n"
    assert list(path.parent.iterdir()) == [path]
