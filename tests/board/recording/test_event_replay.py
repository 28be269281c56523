"""Replays of what happened on emulated boards' links: the same arrivals, times and accounts, to the bit."""

import threading
from pathlib import Path

import pytest
from emulation import emulated
from listener import Listener, frames
from recording_bench import PLATE, at, record, replayed, same

from firmware_protocol.host import HostSession
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.links.carriers.recording import RecordingTarget
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.recording.event_replay import replay_of
from resonator_daemon.board.recording.reader import Origin, open_recording
from resonator_daemon.board.recording.recorder import Recorder
from resonator_daemon.board.session import link_events as wire
from resonator_daemon.board.session.board_reader import BoardReader
from resonator_daemon.board.session.frames import Arrival, Gap, LinkChange, Outage, SingleToneFrame
from simulators.emulator import EmulatorOptions
from simulators.faults import parse_faults

CORPUS = Path(__file__).parents[2] / "corpus"
DEADLINE_S = 30.0  # far beyond what any of this takes: it ends a test that hangs


def test_a_board_with_faults_is_replayed_to_the_bit(tmp_path: Path) -> None:
    port, path = tmp_path / "board", tmp_path / "run.mcap"
    link = SerialTarget(str(port), 4000000)
    faults = parse_faults("bit_error_rate=1e-4,unplug_at_s=0.8,unplug_for_s=0.2,reboot_at_s=1.6")
    with Recorder(path, Origin(PLATE, str(link))) as recorder:
        with (
            emulated(EmulatorOptions("quartz16", pty=port, faults=faults)),
            Listener(link, PLATE, on_event=recorder.put) as it,
        ):
            it.wait_for(lambda _: len(it.reader.counters().boots) == 2)
            it.wait_for_frames(len(frames(it.arrivals)) + 200)
        it.take_the_rest()
    arrivals, counters, differences = replayed(path, PLATE)
    assert differences == 0
    assert last_reason(arrivals) == f"the recording {path.name} is over"
    assert len(arrivals) == len(it.arrivals) + 1
    for live, again in zip(it.arrivals, arrivals, strict=False):
        assert same(live, again), (live, again)
    assert counters == it.reader.counters()
    assert {SingleToneFrame, Gap, LinkChange, Outage} <= {type(arrival) for arrival in arrivals}
    assert counters.connections > 1
    assert len(counters.boots) == 2
    assert counters.bytes_discarded > 0


FIRST = Reason(ReasonCode.UNPLUGGED, "first")


def test_a_replay_can_be_stopped_in_a_long_silence(path: Path) -> None:
    record(
        path,
        [
            wire.Opened(at(0)),
            wire.StateAnnounced(at(0), Condition.STALLED, FIRST),
            wire.TimersRun(at(3_600_000), idle=True),
        ],
    )
    woken = threading.Event()
    target = RecordingTarget(str(path))
    reader = BoardReader(target, PLATE, woken.set, replay=replay_of(target, PLATE))
    reader.start()
    assert woken.wait(DEADLINE_S)
    reader.stop()
    assert reader.pop_arrivals() == [LinkChange(Condition.STALLED, FIRST, at(0).utc_ns, at(0).utc_ns)]


def last_reason(arrivals: list[Arrival]) -> str:
    assert isinstance(arrivals[-1], LinkChange)
    return arrivals[-1].reason.text


BEGUN = [wire.Opened(at(0)), wire.Sent(at(0), HostSession().data_to_send())]  # which asks who it is
NO_ANSWER = wire.TimersRun(at(4000), idle=False)  # after which the connection gives up


@pytest.mark.parametrize(
    ("events", "said"),
    [
        ([BEGUN[0], wire.Sent(at(1), b"\x07"), wire.Closed(at(2))], "0.001 s after its beginning: 07 was sent, now "),
        ([BEGUN[0], wire.TimersRun(at(2), idle=True), wire.Closed(at(3))], "nothing was sent, now "),
        (
            [*BEGUN, wire.Skipped(at(5), 3, 400), wire.Closed(at(6))],
            "0.005 s after its beginning: 3 events with 400 bytes are",
        ),
        ([*BEGUN, wire.Refused(at(5), (FIRST,), False), wire.Closed(at(6))], "closed, first; now: nothing is wrong"),
        ([*BEGUN, wire.Opened(at(5))], "0.005 s after its beginning: the link is opened twice"),
        ([wire.Received(at(0), b"abc")], "0.000 s after its beginning: the link is not open"),
        ([*BEGUN, NO_ANSWER, wire.Lost(at(4001), FIRST), wire.Closed(at(4001))], "first; now: no board answers"),
    ],
)
def test_a_difference_is_counted_and_said(path: Path, events: list[wire.WireEvent], said: str) -> None:
    record(path, events)
    arrivals, _, differences = replayed(path)
    assert differences == 1
    assert f"the recording {path.name} is over; replay differs from it in 1 places, first " in last_reason(arrivals)
    assert said in last_reason(arrivals)


@pytest.mark.parametrize(("code", "differences"), [("wrong_plate", 0), ("unspecified", 0), ("wrong_gate", 1)])
def test_a_refusal_is_compared_by_its_codes_not_by_its_words(tmp_path: Path, code: str, differences: int) -> None:
    with open_recording(str(CORPUS / "refused" / "recording.mcap")) as recording:
        events = list(recording.events())
    reworded = [
        event._replace(problems=(Reason(ReasonCode(code), "other words"),))
        if isinstance(event, wire.Refused)
        else event
        for event in events
    ]
    record(tmp_path / "run.mcap", reworded)
    assert replayed(tmp_path / "run.mcap")[2] == differences


def test_a_recording_cut_off_is_replayed_up_to_there(path: Path) -> None:
    record(path, [wire.StateAnnounced(at(0), Condition.STARTING, FIRST), wire.Opened(at(1))])
    content = path.read_bytes()
    path.write_bytes(content[: content.rindex(b"\x0f\x04" + bytes(7))])  # the end of its data
    arrivals, _, differences = replayed(path)
    assert differences == 0
    reasons = [arrival.reason.text for arrival in arrivals if isinstance(arrival, LinkChange)]
    assert reasons == ["first", f"the recording {path.name} is over; its file is cut off; all before that was replayed"]
