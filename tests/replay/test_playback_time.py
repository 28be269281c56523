"""The time that passes in a replay is that of its recording."""

from pathlib import Path

import pytest

from resonator_daemon.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.recording.reader import Mark, open_recording
from resonator_daemon.replay.source import open_playback

UNPLUGGED = Path(__file__).parents[1] / "corpus" / "unplugged" / "recording.mcap"


def test_each_event_tells_what_time_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    passed: list[int] = []
    pass_time = BoardPipeline.pass_time

    def told(course: BoardPipeline, utc_ns: int) -> None:
        passed.append(utc_ns)
        pass_time(course, utc_ns)

    monkeypatch.setattr(BoardPipeline, "pass_time", told)
    with open_playback(UNPLUGGED) as playback:
        for _ in playback.moments():
            pass
    with open_recording(str(UNPLUGGED)) as recording:
        times = {entry.now.utc_ns for entry in recording.entries() if not isinstance(entry, Mark)}
    assert len(times) > 100
    assert times <= set(passed)
