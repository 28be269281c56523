"""The reader of one board against emulated boards in this process, and against what is no board at all."""

import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from emulation import emulated
from listener import DEADLINE_S, Listener, check_bytes, check_indices, frames, gaps, outages

from firmware_protocol.device import DeviceSession
from resonator_daemon.base.plate import load_plate
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.links.link import Link, LinkLostError
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.session.frames import (
    BoardOnline,
    ChannelisedFrame,
    LinkChange,
    ReaderFailed,
    SingleToneFrame,
)
from resonator_daemon.board.session.link_events import Received, TimersRun, WireEvent
from simulators.emulator import EmulatorOptions
from simulators.faults import parse_faults

SKIN = load_plate("skin32")


def test_frames_over_a_pseudo_terminal(tmp_path: Path) -> None:
    port = tmp_path / "board"
    with emulated(EmulatorOptions("quartz16", pty=port)) as emulator, Listener(SerialTarget(str(port), 4000000)) as it:
        it.wait_for_frames(300)
        counters = it.reader.counters()
    check_bytes(counters)
    assert counters.bytes_discarded == 0
    assert counters.lost.total == 0
    check_indices(it.arrivals)
    kinds = [type(arrival) for arrival in it.arrivals if not isinstance(arrival, LinkChange)]
    assert kinds[0] is BoardOnline
    assert set(kinds[1:]) == {SingleToneFrame}
    seen = frames(it.arrivals)
    assert {b.board_ticks - a.board_ticks for a, b in pairwise(seen)} == {1_000_000}
    # Stamped by the board's clock: evenly, however the bytes came.
    first, last = seen[0].gate_middle, seen[-1].gate_middle
    apart_ns = last.monotonic_ns - first.monotonic_ns - 1_000_000 * (len(seen) - 1)
    assert abs(apart_ns) <= first.uncertainty_ns + last.uncertainty_ns
    assert all(abs(frame.gate_middle.utc_ns - time.time_ns()) < 60e9 for frame in seen)
    assert it.states[-1] == ("online", "board_counts")
    assert emulator.report()["frames_dropped"] == 0


def test_a_brown_out_within_a_channelised_frame_costs_that_frame() -> None:
    """The half frame belongs to the boot before; the new boot's frames count from 0 and all arrive."""
    options = EmulatorOptions("skin32", tcp=("127.0.0.1", 0), faults=parse_faults("brown_out_at_s=0.215"))
    with emulated(options) as emulator, Listener(parse_link(emulator.link.address), SKIN) as it:
        it.wait_for(lambda arrivals: sum(isinstance(a, BoardOnline) for a in arrivals) == 2)
        it.wait_for(lambda arrivals: len(frames(arrivals[-20:])) == 20)
        counters = it.reader.counters()
    check_indices(it.arrivals)
    (half,) = (frame for frame in frames(it.arrivals) if isinstance(frame, ChannelisedFrame) and not frame.known.all())
    assert half.known.any()
    assert 9 <= counters.parts_lost <= 11  # of 20
    assert counters.lost.total < 200
    assert counters.messages_stale == 0


def test_ticks_that_the_board_cannot_have_reached_are_no_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    as_counted = DeviceSession.frame

    def absurd(session: DeviceSession, sequence: int, board_ticks: int, records: bytes) -> bytes:
        return as_counted(session, sequence, board_ticks + (2**63 if sequence % 5 == 3 else 0), records)

    monkeypatch.setattr(DeviceSession, "frame", absurd)
    port = tmp_path / "board"
    with emulated(EmulatorOptions("quartz16", pty=port)), Listener(SerialTarget(str(port), 4000000)) as it:
        it.wait_for_frames(100)
        counters = it.reader.counters()
    assert counters.messages_malformed >= 20
    check_indices(it.arrivals)
    assert all(abs(frame.gate_middle.utc_ns - time.time_ns()) < 60e9 for frame in frames(it.arrivals))


class Opening(LinkTarget):
    """A target that opens whatever link a function returns."""

    scheme = syntax = "test"

    def __init__(self, make: Callable[[], Link]) -> None:
        self._make = make

    @classmethod
    def parse(cls, text: str) -> "Opening":
        raise NotImplementedError

    def open(self) -> Link:
        return self._make()


class GoneAtOnce:
    """A link that is lost by the time it is used, and whose driver lost bytes before."""

    def __init__(self) -> None:
        self.reads = 0
        self.overruns = 1

    def read(self, timeout_s: float) -> bytes:
        self.reads += 1
        raise LinkLostError(ReasonCode.UNPLUGGED, "unplugged")

    def write(self, _data: bytes) -> None: ...

    def close(self) -> None: ...


def test_a_link_that_is_gone_again_and_again_is_opened_again_and_again() -> None:
    link = GoneAtOnce()
    with Listener(Opening(lambda: link), backoff_max_s=0.001) as it:
        deadline = time.monotonic() + DEADLINE_S
        while link.reads < 9 and time.monotonic() < deadline:
            threading.Event().wait(0.01)
        it.take_the_rest()
    assert link.reads >= 9
    assert it.states[-1] == ("waiting", "unplugged")
    assert not any(isinstance(arrival, ReaderFailed) for arrival in it.arrivals)


class Starved(GoneAtOnce):
    """A link whose bytes come while the reader's thread is kept waiting: each wait ends before them."""

    def read(self, timeout_s: float) -> bytes:
        return b"" if timeout_s > 0.0 else b"x"


def test_a_reader_that_was_kept_waiting_reads_before_it_takes_the_board_for_silent() -> None:
    events: list[WireEvent] = []
    enough = threading.Event()

    def note(event: WireEvent) -> None:
        events.append(event)
        if isinstance(event, TimersRun):
            enough.set()

    with Listener(Opening(Starved), on_event=note):
        assert enough.wait(DEADLINE_S)
    timers = [position for position, event in enumerate(events) if isinstance(event, TimersRun)]
    assert all(isinstance(events[position - 1], Received) for position in timers)
    assert not any(event.idle for event in events if isinstance(event, TimersRun))


def test_a_mistake_of_ours_does_not_end_the_reader_unheard() -> None:
    def fail() -> Link:
        raise ZeroDivisionError("mistake")

    with Listener(Opening(fail)) as it:
        _, failed = it.wait_for(lambda arrivals: len(arrivals) > 1)
    assert isinstance(failed, ReaderFailed)
    assert isinstance(failed.error, ZeroDivisionError)


@pytest.mark.parametrize(
    ("faults", "state", "code"),
    [
        ("freeze_at_s=0.3,freeze_for_s=2", "stalled", "no_frames"),
        ("silence_at_s=0.3,silence_for_s=1", "stalled", "no_frames"),
        ("unplug_at_s=0.3,unplug_for_s=0.2", "lost", "unplugged"),
        ("reboot_at_s=0.3", "lost", "board_restarted"),
        ("brown_out_at_s=0.3", "lost", "board_restarted"),
        ("reboot_at_s=0.3,misbehave=same_boot_id", "lost", "clock_jumped"),
        ("tick_step_at_s=0.3,tick_step_ticks=123456789", "lost", "clock_jumped"),
        ("tick_step_at_s=0.3,tick_step_ticks=-123456", "lost", "clock_jumped"),
    ],
)
def test_what_ended_the_frames_is_told_with_the_outage(tmp_path: Path, faults: str, state: str, code: str) -> None:
    port = tmp_path / "board"
    options = EmulatorOptions("quartz16", pty=port, faults=parse_faults(faults))
    with emulated(options), Listener(SerialTarget(str(port), 4000000)) as it:
        it.wait_for(
            lambda arrivals: (
                any(outage.reason.code == code for outage in outages(arrivals)) and len(frames(arrivals[-100:])) == 100
            )
        )
        counters = it.reader.counters()
    check_bytes(counters)
    check_indices(it.arrivals)
    assert (state, code) in it.states
    assert it.states[-1][0] == "online"
    lost = sum(gap.loss.total for gap in gaps(it.arrivals))
    assert counters.lost.total == lost
    seen = frames(it.arrivals)
    # Whatever happened, numbers go on as the time did.
    elapsed_ns = seen[-1].gate_middle.monotonic_ns - seen[0].gate_middle.monotonic_ns
    assert seen[-1].index - seen[0].index == pytest.approx(elapsed_ns / 1e6, abs=4, rel=1e-3)


def test_a_slow_reader_makes_the_board_overflow_and_every_frame_is_put_down_to_it(tmp_path: Path) -> None:
    port = tmp_path / "board"
    faults = parse_faults("slow_reader_bytes_per_s=150000")
    with emulated(EmulatorOptions("quartz16", pty=port, faults=faults)) as emulator:
        with Listener(SerialTarget(str(port), 4000000)) as it:
            it.wait_for(lambda arrivals: sum(gap.loss.board_overflow for gap in gaps(arrivals)) > 300)
            counters = it.reader.counters()
        it.take_the_rest()
    check_indices(it.arrivals)
    assert counters.lost.total == counters.lost.board_overflow
    assert counters.lost.board_overflow <= emulator.report()["frames_dropped"]


def test_bytes_that_come_one_by_one_are_not_taken_one_by_one(tmp_path: Path) -> None:
    port, reads = tmp_path / "board", []

    def tap(event: object) -> None:
        if isinstance(event, Received):
            reads.append(len(event.data))

    faults = parse_faults("split_bytes=1")
    with (
        emulated(EmulatorOptions("quartz16", pty=port, faults=faults)),
        Listener(SerialTarget(str(port), 4000000), on_event=tap, step_frames=(50,)) as it,
    ):
        it.wait_for_frames(300)
        counters = it.reader.counters()
    assert counters.lost.damaged == counters.lost.link_gap == 0
    assert sum(reads) / len(reads) > 10
    assert it.wakes < 20 < len(reads)  # one for each step and for each change of the link
