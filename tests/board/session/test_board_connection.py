"""One opening of a link in simulated time: handshake, clock, silence, reboots."""

from dataclasses import replace

import pytest
from connection_bench import GATE_TICKS, IDENTITY, MS, Bench, SimulatedBoard, online

from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import BoardLog, ResetCause
from firmware_protocol.packets import encode_packet
from resonator_daemon.base.host.load import LoadSample
from resonator_daemon.board.links.link import LinkLostError
from resonator_daemon.board.session.frames import BoardLogLine, BoardOnline, Outage


def test_frames_carry_the_middle_of_their_gate() -> None:
    bench = Bench(SimulatedBoard(), step_ns=MS // 20)
    bench.board.boot(7, bench.now_ns)
    booted_ns = bench.now_ns
    bench.run(150)
    assert len(bench.frames) > 100
    for frame in bench.frames:
        middle_ns = booted_ns + frame.board_ticks - GATE_TICKS // 2  # 1 GHz: a tick is a nanosecond
        bound_ns = frame.gate_middle.uncertainty_ns
        assert abs(frame.gate_middle.monotonic_ns - middle_ns) <= bound_ns < GATE_TICKS // 5
        assert frame.gate_middle.utc_ns == frame.gate_middle.monotonic_ns + 10**18


@pytest.fixture
def bench() -> Bench:
    return online()


def test_silence_is_noticed_asked_about_and_then_the_end(bench: Bench) -> None:
    bench.board.silent = True
    bench.run(51)  # the last frame came within the millisecond before
    assert bench.states[-1][0] == "online"
    bench.run(3)
    assert bench.states[-1] == ("stalled", "no_frames")
    bench.run(2990)  # as a board that erases flash
    with pytest.raises(LinkLostError, match=r"silent for 3\.1 s"):
        bench.run(20)


BUSY = LoadSample(85, 100)


def test_a_busy_computer_is_reported_within_three_seconds_until_two_seconds_after_its_end(bench: Bench) -> None:
    bench.load = LoadSample(40, 100)  # a computer that is used, and has time for the daemon
    bench.run(5000)
    bench.load = LoadSample(100, 100)
    bench.run(600)  # a short pause
    bench.load = LoadSample(40, 40)
    bench.run(5000)
    assert bench.states[-1] == ("online", "board_counts")
    bench.load = BUSY
    bench.run(3000)
    assert bench.states[-1] == ("online", "computer_busy")
    assert "85 %" in bench.changes[-1].reason.text
    assert (running := bench.connection.snapshot()) is not None
    assert running.load.busy is not None  # a replay that begins here goes on so
    bench.load = LoadSample(95, 100)
    bench.run(20_000)
    bench.load = LoadSample(40, 60)
    bench.run(3000)
    assert [code for _, code in bench.states[1:]] == ["board_counts", "computer_busy", "board_counts"]


def test_a_board_without_frames_is_stalled_half_a_second_later_on_a_busy_computer(bench: Bench) -> None:
    bench.load = BUSY
    bench.board.silent = True
    bench.run(550)
    assert bench.states[-1] == ("online", "board_counts")
    bench.run(4)
    assert bench.states[-1] == ("stalled", "no_frames")
    bench.run(2000)
    assert bench.states[-1] == ("stalled", "computer_busy")
    bench.board.silent = False
    bench.run(50)
    assert bench.states[-1] == ("online", "computer_busy")


def test_time_in_which_programs_wait_for_a_processor_does_not_count_as_silence(bench: Bench) -> None:
    bench.load = LoadSample(0, 50)
    bench.board.silent = True
    bench.run(103)
    assert bench.states[-1][0] == "online"
    bench.run(5)
    assert bench.states[-1][0] == "stalled"


def test_a_board_that_is_deaf_and_mute_for_two_and_a_half_seconds_goes_on_in_its_run(bench: Bench) -> None:
    bench.board.frozen = True
    bench.run(2500)
    bench.board.frozen = False
    bench.board.skip_gates(bench.now_ns)
    bench.run(300)
    assert [state for state, _ in bench.states[-2:]] == ["stalled", "online"]
    assert bench.board.session.started == 1
    (gap,) = bench.gaps
    assert gap.loss.total == pytest.approx(2500, abs=1)
    bench.check_indices()


def test_a_board_that_was_only_late_is_online_again_with_its_outage_told(bench: Bench) -> None:
    last = bench.frames[-1]
    bench.board.silent = True
    bench.run(200)
    bench.board.silent = False
    bench.run(50)
    assert [state for state, _ in bench.states[-2:]] == ["stalled", "online"]
    (outage,) = (arrival for arrival in bench.arrivals if isinstance(arrival, Outage))
    assert outage.frames_lost == 200
    assert outage.reason.code == "no_frames"
    assert outage.start_utc_ns == last.gate_middle.utc_ns
    assert outage.end_utc_ns - outage.start_utc_ns == pytest.approx(201 * MS, abs=MS)
    bench.check_indices()
    assert bench.counters.connections == 0  # the reader counts these


def test_a_board_that_answers_pings_and_counts_nothing_is_asked_to_go_on(bench: Bench) -> None:
    sent = bench.board.session.receive(encode_packet(MessageType.STOP, 999), 0)  # as if something else had stopped it
    assert sent
    bench.run(150)
    assert bench.board.session.started == 2


@pytest.mark.parametrize("idle", [True, False])
def test_bytes_that_are_no_frames_are_silence_too(bench: Bench, idle: bool) -> None:
    for _ in range(1200):  # garbage at every turn
        bench.now_ns += MS // 2
        bench.connection.receive(b"no frame", bench.host_time())
        bench.connection.run_timers(bench.host_time(), idle=idle)
    bench.run(0)
    assert bench.states[-1][0] == "stalled"


def test_a_late_answer_with_older_ticks_than_the_newest_frame_is_an_answer(bench: Bench) -> None:
    """A board may take 100 ms to answer; frames go on meanwhile."""
    answer = bench.board.session.receive
    held: list[tuple[int, bytes]] = []

    def slow(data: bytes, board_ticks: int) -> bytes:
        held.append((bench.now_ns + 80 * MS, answer(data, board_ticks)))
        out = b""
        while held and held[0][0] <= bench.now_ns:
            out += held.pop(0)[1]
        return out

    bench.board.session.receive = slow  # type: ignore[method-assign]
    bench.run(3000)
    assert bench.states[-1][0] == "online"
    assert len(bench.states) == 2
    assert bench.counters.lost.total == 0
    assert bench.counters.clock_restarts == 0


def test_a_board_that_does_not_hear_any_more_is_told_of_and_forgotten_pings_are_forgotten(bench: Bench) -> None:
    bench.board.session.receive = lambda _data, _ticks: b""  # type: ignore[method-assign]
    bench.run(30_000)
    assert bench.states[-1] == ("online", "no_pong")
    assert len(bench.connection.pings.snapshot()) < 1000
    del bench.board.session.receive
    bench.run(3000)
    assert bench.states[-1] == ("online", "board_counts")
    assert bench.counters.lost.total == 0


def test_a_flood_of_log_lines_is_cut_and_counted(bench: Bench) -> None:
    line = bench.board.session.log(BoardLog(20, "again"), 0)
    bench.connection.receive(line * 500, bench.host_time())
    bench.run(1)
    said = [arrival for arrival in bench.arrivals if isinstance(arrival, BoardLogLine)]
    assert len(said) == 20
    assert bench.counters.log_lines_dropped == 480
    bench.run(1000)
    bench.connection.receive(line, bench.host_time())
    bench.run(1)
    assert sum(isinstance(arrival, BoardLogLine) for arrival in bench.arrivals) == 21


def test_a_reboot_is_told_with_its_cause_and_the_host_measures_it(bench: Bench) -> None:
    frames = len(bench.frames)
    bench.board.identity = replace(IDENTITY, reset_cause=ResetCause.BROWN_OUT)
    bench.board.boot(8, bench.now_ns)
    bench.run(100)  # nothing comes: it waits to be asked
    bench.run(300)
    reasons = [change.reason for change in bench.changes if change.state == "lost"]
    assert [reason.code for reason in reasons] == ["board_restarted", "board_restarted"]
    assert "brown-out" in reasons[-1].text
    assert bench.states[-1][0] == "online"
    assert len(bench.frames) > frames + 100
    bench.check_indices()
    (gap,) = bench.gaps
    outage = next(arrival for arrival in bench.arrivals if isinstance(arrival, Outage))
    assert outage.reason == reasons[-1]
    assert outage.frames_lost == gap.loss.total == pytest.approx((outage.end_utc_ns - outage.start_utc_ns) / MS, abs=3)
    boots = bench.counters.boots
    assert [boot.boot_id for boot in boots] == [7, 8]
    assert [boot.connections for boot in boots] == [1, 1]
    assert sum(boot.frames for boot in boots) == bench.counters.frames
    assert boots[1].lost == boots[1].lost_in_outages == gap.loss
    assert not [arrival for arrival in bench.arrivals if isinstance(arrival, BoardOnline)][-1].continues
