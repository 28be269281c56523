"""Boards that are not what they were, or do not keep their word: refused, left or flagged, with both values named."""

import re
from dataclasses import replace
from typing import Any

import pytest
from connection_bench import DESCRIPTION, GATE_TICKS, IDENTITY, MS, PLATE, Bench, SimulatedBoard, online

from firmware_protocol.device import DeviceSession
from firmware_protocol.messages import Configuration, encode_message
from resonator_daemon.board.links.link import LinkLostError
from resonator_daemon.board.session.compatibility import BoardRefusedError
from resonator_daemon.board.session.frames import BoardLogLine


def test_a_board_that_does_nothing_but_start_anew_is_given_up() -> None:
    bench = Bench(SimulatedBoard())

    def start_anew_for_ever() -> None:
        for boot_id in range(1, 5000):
            bench.run(1)
            bench.board.boot(boot_id, bench.now_ns)

    with pytest.raises(LinkLostError, match="no board answers"):
        start_anew_for_ever()
    assert bench.now_ns < 15_000 * MS


def test_another_board_on_the_link_is_refused_with_both_named() -> None:
    bench = online()
    bench.board = SimulatedBoard(replace(IDENTITY, serial_number="T-2"), boot_id=9)
    bench.board.boot(9, bench.now_ns)
    bench.reopen()
    with pytest.raises(BoardRefusedError, match="another board is on this link: T-2; T-1 was here before"):
        bench.run(200)
    bench.close()
    assert bench.counters.boots[0].boot_id == 7
    assert len(bench.counters.boots) == 1


@pytest.mark.parametrize(
    ("identity", "changes", "said"),
    [
        ({"product": "a scale"}, {}, "product: the board reports a scale, before it reported test board"),
        ({}, {"reference_millihertz": 10**12 + 1}, "reference_millihertz: the board reports 1000000000001, before"),
        ({}, {"gate_ticks_max": 2_000_000}, "gate_ticks_max: the board reports 2000000, before it reported 1000000000"),
        ({}, {"plate": "x", "channels": 3}, r'set plate = "x", or connect a board of quartz16 \(1 other difference\)$'),
    ],
)  # fmt: skip
def test_a_board_that_describes_itself_otherwise_than_before_is_refused(
    identity: dict[str, str], changes: dict[str, int], said: str
) -> None:
    bench = online()
    bench.board = SimulatedBoard(replace(IDENTITY, **identity), replace(DESCRIPTION, **changes), boot_id=9)  # type: ignore[arg-type]
    bench.reopen()
    with pytest.raises(BoardRefusedError, match=said):
        bench.run(200)


def test_a_plate_calibrated_with_another_board_is_refused() -> None:
    calibration = PLATE.calibration.model_copy(update={"unit": "RD-0042"})
    bench = Bench(SimulatedBoard(), plate=PLATE.model_copy(update={"calibration": calibration}))
    with pytest.raises(BoardRefusedError, match="the board is T-1, the plate file was calibrated with RD-0042"):
        bench.run(200)


def test_a_gate_that_was_not_asked_for_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def stubborn(message: Any) -> bytes:
        return encode_message(Configuration(2 * GATE_TICKS) if isinstance(message, Configuration) else message)

    bench = Bench(SimulatedBoard())
    monkeypatch.setattr("firmware_protocol.device.encode_message", stubborn)
    with pytest.raises(BoardRefusedError, match="gates of 2000000 ticks instead of 1000000"):
        bench.run(200)


def test_a_gate_that_is_not_kept_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    as_counted = DeviceSession.frame

    def wide(session: DeviceSession, sequence: int, board_ticks: int, records: bytes) -> bytes:
        return as_counted(session, sequence, board_ticks + 1000 * sequence, records)

    bench = Bench(SimulatedBoard())
    monkeypatch.setattr(DeviceSession, "frame", wide)
    with pytest.raises(BoardRefusedError, match="does not keep its gate: 1001000 ticks from frame to frame, 1000000"):
        bench.run(200)


def test_a_reference_that_is_not_what_was_described_is_flagged_with_both_named() -> None:
    bench = Bench(SimulatedBoard())
    bench.board.fast_ppm = 2000.0
    bench.run(10_000)
    assert bench.states[-1] == ("online", "tick_rate")
    reason = bench.changes[-1].reason.text
    assert re.search(r"describes 1000000000 Hz, its ticks come at 100[12]\d{6} Hz \(give or take \d+ ppm", reason)
    assert bench.states.count(("online", "tick_rate")) == 1
    bench.check_indices()


def test_a_fault_of_the_board_is_its_own_words_and_waited_out() -> None:
    bench = Bench(SimulatedBoard())
    bench.board.session.set_fault("the reference oscillator does not swing", 0)
    with pytest.raises(LinkLostError):
        bench.run(200)
    bench.close()
    assert bench.states[-1] == ("stalled", "board_fault")
    assert bench.changes[-1].reason.text.endswith("the reference oscillator does not swing")


def test_a_fault_in_a_run_is_logged_at_once_reported_and_followed_by_a_new_run() -> None:
    bench = online()
    log = bench.board.session.set_fault("reference lost", bench.board.ticks(bench.now_ns))
    bench.connection.receive(log, bench.host_time())
    with pytest.raises(LinkLostError):
        bench.run(500)
    assert BoardLogLine(40, "reference lost") in bench.arrivals + bench.queue.pop_all()
    bench.board.session.set_fault(None, 0)
    frames = len(bench.frames)
    bench.reopen()
    bench.run(300)
    assert bench.states[-1][0] == "online"
    assert bench.board.session.started == 2
    assert len(bench.frames) > frames + 100
    bench.check_indices()
