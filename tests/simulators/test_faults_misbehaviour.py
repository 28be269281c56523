"""Boards that do not keep their word, as a host meets them."""

from typing import get_args

import pytest
from fake_plate import fake_board

from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import Configuration, Description, Identity, decode_message, encode_message
from firmware_protocol.packets import Packet, PacketDecoder, encode_packet
from simulators.board import Board
from simulators.faults.misbehaviour import Misbehaviour
from simulators.faults.plan import Violation

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
