"""Faults of links and boards: as many as asked for, where they are said to be, and counted exactly."""

from collections import Counter
from functools import partial
from typing import get_args

import numpy as np
import pytest
from fake_plate import fake_board

from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import Configuration, Description, Identity, decode_message, encode_message
from firmware_protocol.packets import Packet, PacketDecoder, encode_packet
from simulators.board import Board
from simulators.faults import FaultEvent, FaultPlan
from simulators.faults.account import FaultCounts
from simulators.faults.byte_faults import ByteFaults
from simulators.faults.misbehaviour import Misbehaviour
from simulators.faults.plan import Violation
from simulators.faults.script import Action, Script
from simulators.faults.timing import Line, Lot, Splitter

FRAME_BYTES = 204


class Wire:
    """Damages frames one after the other and adds up what was done."""

    def __init__(self, seed: int = 1, **faults: float) -> None:
        self._faults = ByteFaults(FaultPlan.model_validate(faults), seed)
        self.counts = FaultCounts()
        self.sent_bytes = 0

    def send(self, packets: bytes, elapsed_s: float = 0.0) -> bytes:
        data, harm = self._faults.damage(packets, elapsed_s)
        self.counts.add(harm or FaultCounts())
        self.sent_bytes += len(data)
        return data


def frame(sequence: int) -> bytes:
    return encode_packet(MessageType.FRAME, sequence, bytes(176))


def flipped_bits(before: bytes, after: bytes) -> list[int]:
    difference = np.frombuffer(before, np.uint8) ^ np.frombuffer(after, np.uint8)
    return np.flatnonzero(np.unpackbits(difference, bitorder="little")).tolist()


def test_bits_flip_independently_at_the_rate_asked_for_and_are_counted() -> None:
    wire = Wire(bit_error_rate=1e-3)
    positions: list[int] = []
    hit = []
    for sequence in range(3000):
        whole = frame(sequence)
        flipped = flipped_bits(whole, wire.send(frame(sequence)))
        positions += [sequence * 8 * FRAME_BYTES + bit for bit in flipped]
        hit += [sequence] if flipped else []
    assert wire.counts.bits_flipped == len(positions)
    assert wire.counts.frame_sequences_hit == hit
    assert wire.counts.frames_hit == wire.counts.packets_hit == len(hit)
    assert wire.counts.parts_hit == 0
    # 4.9 million bits: 4896 flips expected, standard deviation 70; gaps exponential; no place in a byte preferred.
    assert len(positions) == pytest.approx(4896, abs=280)
    gaps = np.diff(positions)
    assert gaps.mean() == pytest.approx(1000, rel=0.06)
    assert gaps.std() == pytest.approx(1000, rel=0.08)
    assert (gaps < 693).mean() == pytest.approx(0.5, abs=0.03)
    assert np.bincount(np.array(positions) % 8).min() > 500


@pytest.mark.parametrize("length", [1, 2, 5, 16])
def test_a_burst_is_as_long_as_asked_for_and_hits_one_frame(length: int) -> None:
    wire = Wire(burst_rate_hz=100.0, burst_bits=length)
    inner, places = Counter[int](), set()
    for sequence in range(4000):
        flipped = flipped_bits(frame(sequence), wire.send(frame(sequence), sequence * 1e-3))
        if flipped:
            assert sequence == wire.counts.frame_sequences_hit[-1]
            assert flipped[-1] - flipped[0] == length - 1
            inner[len(flipped)] += 1
            places.add(flipped[0] // 8)
    assert wire.counts.bursts == wire.counts.frames_hit == inner.total() == pytest.approx(400, abs=80)
    assert wire.counts.bits_flipped == sum(count * times for count, times in inner.items())
    assert len(inner) > 5 if length == 16 else len(inner) <= length
    assert max(places) - min(places) > 190


GATE_TICKS = 1000


def liar(*lies: Violation) -> Board:
    return fake_board(misbehaviour=Misbehaviour(lies))


def answer(board: Board, kind: MessageType, payload: bytes = b"") -> Packet:
    board.receive(encode_packet(kind, 1, payload), 0)
    outgoing = board.next_output()
    assert outgoing is not None
    (packet,) = PacketDecoder(from_board=True).feed(outgoing.data)
    assert isinstance(packet, Packet)
    return packet


def described(board: Board) -> tuple[Identity, Description]:
    return (
        decode_message(Identity, answer(board, MessageType.IDENTIFY).payload),
        decode_message(Description, answer(board, MessageType.DESCRIBE).payload),
    )


def configured(board: Board) -> int:
    packet = answer(board, MessageType.CONFIGURE, encode_message(Configuration(GATE_TICKS)))
    assert packet.type == MessageType.CONFIGURED
    return decode_message(Configuration, packet.payload).gate_ticks


@pytest.mark.parametrize("lie", get_args(Violation))
def test_each_lie_changes_what_it_says_and_nothing_else(lie: Violation) -> None:
    honest_identity, honest = described(liar())
    board = liar(lie)
    described(board)  # one lies from the second time on
    identity, description = described(board)
    differences = {
        name
        for told, truth in ((identity, honest_identity), (description, honest))
        for name in told.__dataclass_fields__
        if getattr(told, name) != getattr(truth, name)
    }
    assert differences == {
        "channels0": {"channels"},
        "channels5": {"channels"},
        "other_product": {"product"},
        "other_plate": {"plate"},
        "reference_changes": {"reference_millihertz"},
    }.get(lie, set())


@pytest.mark.parametrize(("lie", "confirmed", "counted"), [("other_gate", 2000, 2000), ("hidden_gate", 1000, 500)])
def test_gates_that_were_not_asked_for(lie: Violation, confirmed: int, counted: int) -> None:
    board = liar(lie)
    assert configured(board) == confirmed
    answer(board, MessageType.START)
    frames = board.advance(4 * GATE_TICKS)
    assert [frame.board_ticks for frame in frames] == list(range(counted, 4001, counted))


def test_random_unplugs_follow_each_other_and_mix_with_the_script() -> None:
    plan = FaultPlan(unplug_rate_hz=2.0, unplug_for_s=0.1, events=(FaultEvent(at_s=50.0, what="reboot"),))
    script = Script(plan, 3)
    steps = [script.pop() for _ in range(2001)]
    assert [step.at_s for step in steps] == sorted(step.at_s for step in steps)
    (reboot,) = [step for step in steps if step.action is Action.REBOOT]
    assert reboot.at_s == 50.0
    pulls = np.array([step.at_s for step in steps if step.action is Action.UNPLUG])
    returns = np.array([step.at_s for step in steps if step.action is Action.PLUG_IN])
    assert returns - pulls == pytest.approx(0.1)
    gaps = np.diff(pulls) - 0.1
    assert gaps.min() > 0.0
    assert gaps.mean() == pytest.approx(0.5, rel=0.1)
    assert gaps.std() == pytest.approx(0.5, rel=0.15)
    again = Script(plan, 3)
    assert [again.pop() for _ in range(100)] == steps[:100]


MS = 1_000_000


def test_clumps_leave_whole_at_multiples_of_their_time() -> None:
    clumped = Line(FaultPlan(clump_ms=16.0, delay_ms=2.0), 1)
    for now_ms in range(40):
        clumped.put(Lot(bytes([now_ms]), frames=1), now_ms * MS)
    left = [(now_ms, lot.data) for now_ms in range(49) for lot in iter(partial(clumped.pop, now_ms * MS), None)]
    assert [(now_ms, len(data)) for now_ms, data in left] == [(16, 15), (32, 16), (48, 9)]
    assert b"".join(data for _, data in left) == bytes(range(40))
    assert clumped.frames == 0


@pytest.mark.parametrize("rate", [50.0, 10_000.0, 333_333.0])
def test_a_slow_reader_takes_its_rate_and_not_a_byte_more(rate: float) -> None:
    slow = Splitter(FaultPlan(slow_reader_bytes_per_s=rate), 1)
    now_ns = taken = 0
    steps = np.random.default_rng(1)
    while now_ns < 3_000 * MS:
        piece = slow.piece_bytes(1000, now_ns)
        slow.wrote(piece)
        taken += piece
        due_ns = slow.next_ns
        now_ns = due_ns if due_ns is not None else now_ns + int(steps.integers(1, 3 * MS))
    burst = max(1.0, rate / 100)
    assert rate * 2.9 <= taken <= rate * now_ns * 1e-9 + burst
