"""Boards that are nearly right: what is wrong with their packets is in the state of the link, with its code."""

from collections.abc import Callable

import pytest
from connection_bench import Bench, SimulatedBoard, online
from test_probe import LossyLink

from firmware_protocol.host import PacketRefusal
from firmware_protocol.layouts import MessageType
from firmware_protocol.packets import Packet, PacketDecoder, encode_packet
from resonator_daemon.board.links.link import LinkLostError
from resonator_daemon.board.session.link_state import RefusalWatch
from resonator_daemon.board.session.probe import NoBoardError, probe

Change = Callable[[Packet], Packet | None]


def rewritten(data: bytes, change: Change) -> bytes:
    """Return packets of a board with each one changed, and its checksum right; None: not sent."""
    out = b""
    for packet in PacketDecoder(from_board=True).feed(data):
        assert isinstance(packet, Packet)
        if (sent := change(packet)) is not None:
            kind, sequence, ticks, boot_id, payload = sent
            out += encode_packet(kind, sequence, payload, board_ticks=ticks, boot_id=boot_id)
    return out


def short_by_a_byte(packet: Packet) -> Packet:
    return packet._replace(payload=packet.payload[:-1])


def without_its_last_field(packet: Packet) -> Packet:
    """Of IDENTITY: its first field alone is left."""
    if packet.type != MessageType.IDENTITY:
        return packet
    return packet._replace(payload=packet.payload[: 2 + packet.payload[1]])


def no_pong(packet: Packet) -> Packet | None:
    return None if packet.type == MessageType.PONG else packet


def test_frames_that_are_a_byte_short_are_named() -> None:
    board = SimulatedBoard()
    board.slip = lambda data: rewritten(data, short_by_a_byte)
    bench = Bench(board)
    bench.run(300)
    assert bench.states[-1] == ("stalled", "frame_length")
    ((refusal, count),) = bench.counters.refusals.items()
    assert (refusal.code, bench.counters.messages_malformed) == ("frame_length", count)
    assert count > 100
    bench.close()
    assert bench.total.refusals[refusal] == count


@pytest.mark.parametrize(
    ("change", "code"),
    [(without_its_last_field, "message_fields"), (no_pong, "no_pong"), (lambda _: None, "no_board_answers")],
)
def test_a_handshake_that_comes_to_no_end_has_its_cause(change: Change, code: str) -> None:
    board = SimulatedBoard()
    board.slip_answer = lambda data: rewritten(data, change)
    bench = Bench(board)
    with pytest.raises(LinkLostError):
        bench.run(3500)
    bench.arrivals += bench.queue.pop_all()
    assert bench.states[-1] == ("stalled", code)


@pytest.mark.parametrize("lost", ["IDENTITY", "DESCRIPTION", "CONFIGURED", "STARTED"])
def test_a_lost_answer_is_asked_for_again_while_pings_are_answered(lost: str) -> None:
    board, seen = SimulatedBoard(), []

    def lose_first(packet: Packet) -> Packet | None:
        if seen or packet.type != MessageType[lost]:
            return packet
        seen.append(packet)
        return None

    board.slip_answer = lambda data: rewritten(data, lose_first)
    bench = Bench(board)
    bench.run(900)
    assert seen
    assert bench.states[-1][0] == "online"


def test_refusals_are_reported_while_frames_come_and_no_longer_than_they_last() -> None:
    bench = online()
    every_other = iter(range(1 << 30))
    bench.board.slip = lambda data: rewritten(
        data, lambda packet: short_by_a_byte(packet) if next(every_other) % 2 else packet
    )
    bench.run(1500)
    assert bench.states[-1] == ("online", "frame_length")
    bench.board.slip = bytes
    bench.run(2500)
    assert bench.states[-1] == ("online", "board_counts")
    assert len([state for state, _ in bench.states if state != "online"]) == 1  # starting


def test_the_most_frequent_refusal_is_that_of_the_last_second() -> None:
    often, seldom = PacketRefusal("frame_length", "x"), PacketRefusal("frame_part", "y")
    counts: dict[PacketRefusal, int] = {}
    watch = RefusalWatch(counts, 0)
    counts |= {often: 5, seldom: 1}
    assert watch.most_frequent == often
    assert watch.update(10**9)
    counts[seldom] = 3
    assert not watch.update(2 * 10**9 - 1)
    assert watch.update(2 * 10**9)
    assert watch.most_frequent == seldom


class TwistedLink(LossyLink):
    """A board whose packets are changed, or come twice."""

    def __init__(self, change: Change, times: int = 1) -> None:
        super().__init__(set())
        self._change = change
        self._times = times

    def read(self, timeout_s: float) -> bytes:
        return rewritten(super().read(timeout_s), self._change) * self._times


def test_a_probe_names_what_is_wrong_with_the_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("resonator_daemon.board.session.probe.ANSWER_S", 0.2)
    with pytest.raises(NoBoardError, match="missing") as refused:
        probe(TwistedLink(without_its_last_field))
    assert refused.value.is_a_board
    assert refused.value.refused.code == "message_fields"


def test_answers_that_come_twice_do_not_make_a_board_count() -> None:
    found = probe(TwistedLink(lambda packet: packet, times=2))
    assert len(found.round_trips_s) > 10
    assert not found.counting
