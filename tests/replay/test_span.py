"""Which moments are in a part of a recording."""

from pathlib import Path

from resonator_daemon.plate import load_plate
from resonator_daemon.recording.reader import Mark, Origin
from resonator_daemon.recording.recorder import Recorder
from resonator_daemon.replay.span import Span, find_span
from resonator_daemon.session.host_time import HostTime
from resonator_daemon.session.link_events import Received

BEGUN = HostTime(10**9, 1_700_000_000 * 10**9, 0)


def at(ns: int) -> HostTime:
    return HostTime(BEGUN.monotonic_ns + ns, BEGUN.utc_ns - BEGUN.monotonic_ns, 0)


def test_a_part_has_its_first_moment_and_not_its_last() -> None:
    span = Span(BEGUN, at(5).monotonic_ns, at(9).monotonic_ns)
    assert [span.is_before(at(ns)) for ns in (4, 5, 6)] == [True, False, False]
    assert [span.is_over(at(ns)) for ns in (8, 9, 10)] == [False, True, True]
    assert span.words == " from 5e-09 s until 9e-09 s"


def test_of_marks_that_say_the_same_the_first_counts(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, Origin(load_plate("quartz16"), "tcp://board:1")) as recorder:
        recorder.put(Received(at(0), b"x"))
        for text, ns in (("press", 3), ("press", 5), ("release", 7), ("release", 9)):
            recorder.mark(Mark(at(ns), text))
    span = find_span(path, "press", "release")
    assert (span.begun, span.from_ns, span.until_ns) == (at(0), at(3).monotonic_ns, at(7).monotonic_ns)
