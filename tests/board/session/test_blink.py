"""A board that counts is asked to make itself seen: it goes on counting, and there is always an answer."""

import threading
from pathlib import Path

import pytest
from connection_bench import Bench, SimulatedBoard, online
from emulation import emulated
from listener import Listener, check_indices, frames

from firmware_protocol.layouts import Capability
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.session.frames import Arrival, BlinkAnswered
from simulators.emulator import EmulatorOptions


def located(arrivals: list[Arrival]) -> list[str | None]:
    return [arrival.refused for arrival in arrivals if isinstance(arrival, BlinkAnswered)]


@pytest.fixture
def bench() -> Bench:
    return online(capabilities=int(Capability.LOCATE))


def test_a_board_blinks_and_counts_on(tmp_path: Path) -> None:
    port = tmp_path / "board"
    with emulated(EmulatorOptions("quartz16", pty=port)) as emulator, Listener(SerialTarget(str(port), 4000000)) as it:
        it.wait_for_frames(100)
        answers: list[tuple[str | None, int]] = []
        for _ in range(3):
            done = (lambda refused: answers.append((refused, threading.get_ident())),)
            asking = threading.Thread(target=it.reader.blink, args=done)
            asking.start()
            asking.join()
        it.wait_for(lambda _: len(answers) >= 3)
        assert answers == [(None, threading.get_ident())] * 3  # in this thread, whoever asked
        it.wait_for_frames(len(frames(it.arrivals)) + 200)
        counters = it.reader.counters()
    assert emulator._board.times_located >= 1
    check_indices(it.arrivals)
    assert (counters.lost.link_gap, counters.lost.damaged) == (0, 0)  # a busy computer overruns
    assert (counters.connections, counters.messages_stale, counters.messages_unknown) == (1, 0, 0)
    assert {state for state, _ in it.states} <= {"starting", "online", "stalled"}  # it may be late


def test_a_request_that_is_lost_is_repeated(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    deafen(bench.board, monkeypatch)
    bench.connection.blink(bench.host_time())
    bench.run(200)
    assert located(bench.arrivals) == []
    monkeypatch.undo()
    bench.run(200)
    assert located(bench.arrivals) == [None]
    assert bench.board.session.located == 1
    bench.run(3000)
    assert located(bench.arrivals) == [None]
    assert bench.board.session.located == 1


def test_a_board_that_does_not_answer_is_reported_and_counts_on(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    deafen(bench.board, monkeypatch)
    bench.connection.blink(bench.host_time())
    bench.run(2990)
    assert located(bench.arrivals) == []
    bench.run(20)
    assert located(bench.arrivals) == ["the board did not answer within 3 s"]
    bench.check_indices()
    assert bench.gaps == []
    bench.run(1000)
    assert len(located(bench.arrivals)) == 1


def deafen(board: SimulatedBoard, monkeypatch: pytest.MonkeyPatch) -> None:
    hearing = board.step
    monkeypatch.setattr(board, "step", lambda _data, now_ns: hearing(b"", now_ns))
