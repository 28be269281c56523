"""How fast recorded time passes, which moments are in a part, and that a slow broker is waited for."""

from pathlib import Path

import pytest
from brokers import Mosquitto
from observer import observe

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.recording.reader import Mark, Origin
from resonator_daemon.board.recording.recorder import Recorder
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.link_events import Received
from resonator_daemon.mqtt import outbox
from resonator_daemon.tools.replay.outputs import BrokerOutput
from resonator_daemon.tools.replay.recorded_pipeline import Moment, open_replay
from resonator_daemon.tools.replay.run import AtSpeed
from resonator_daemon.tools.replay.span import Span, find_span

TOUCHES = Path(__file__).parents[2] / "corpus" / "touches" / "recording.mcap"
BEGUN = HostTime(10**9, 1_700_000_000 * 10**9, 0)


def moment(monotonic_ms: int) -> Moment:
    return Moment(HostTime(monotonic_ms * 10**6, 0, 0))


async def test_time_passes_as_many_times_as_fast_from_the_first_moment_on() -> None:
    now_ns = 5 * 10**9
    waits: list[float] = []

    async def sleep(seconds: float) -> None:
        nonlocal now_ns
        waits.append(round(seconds, 6))
        now_ns += round(seconds * 1e9)

    pacing = AtSpeed(4.0, lambda: now_ns, sleep)
    for at_ms in (700, 1100, 1100, 5100):
        await pacing.wait_for(moment(at_ms))
    now_ns += 10**9  # what is late is not waited for
    await pacing.wait_for(moment(5200))
    await pacing.wait_for(moment(9700))
    assert waits == [0, 0.1, 0, 1.0, 0, 0.15]


async def test_nothing_is_dropped_for_want_of_room(mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "STREAMS_WAITING_MAX", 40)
    monkeypatch.setattr("resonator_daemon.tools.replay.outputs.WAITING_MAX", 20)
    async with observe(mosquitto.url) as heard:
        output = BrokerOutput(Mqtt(url=mosquitto.url), "hand", TOUCHES.name)
        count = 0
        with open_replay(TOUCHES, daemon_boot_id=output.daemon_boot_id) as replaying:
            async with output:
                for now in replaying.moments():
                    for published in now.messages:
                        await output.put(published)
                        count += published.topic.path == "forces"
        assert output.dropped == {}
        assert len(await heard.until_count("resonator/hand/forces", count)) == count > 100


def at(ns: int) -> HostTime:
    return HostTime(BEGUN.monotonic_ns + ns, BEGUN.utc_ns - BEGUN.monotonic_ns, 0)


def test_a_part_has_its_first_moment_and_not_its_last() -> None:
    span = Span(BEGUN, at(5).monotonic_ns, at(9).monotonic_ns)
    assert [span.is_before(at(ns)) for ns in (4, 5, 6)] == [True, False, False]
    assert [span.is_over(at(ns)) for ns in (8, 9, 10)] == [False, True, True]
    assert span.words == " from 5e-09 s until 9e-09 s"


def test_of_marks_that_state_the_same_the_first_counts(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, Origin(load_plate("quartz16"), "tcp://board:1")) as recorder:
        recorder.put(Received(at(0), b"x"))
        for text, ns in (("press", 3), ("press", 5), ("release", 7), ("release", 9)):
            recorder.mark(Mark(at(ns), text))
    span = find_span(path, "press", "release")
    assert (span.begun, span.from_ns, span.until_ns) == (at(0), at(3).monotonic_ns, at(7).monotonic_ns)
