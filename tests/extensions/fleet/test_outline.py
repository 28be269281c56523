"""Parts of a recording: where each begins."""

from pathlib import Path

from recording_bench import PLATE, at

from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.writer import Published, RecordingWriter
from resonator_daemon.board.session.link_events import Received
from resonator_daemon.extensions.fleet.outline import read_outline


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
