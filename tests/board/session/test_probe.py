"""Asking a board who it is, over a link that loses requests, and how well its ticks keep time."""

import threading

import pytest

from firmware_protocol.device import DeviceSession
from firmware_protocol.layouts import Capability
from firmware_protocol.messages import CounterKind, Description, Identity
from firmware_protocol.packets import encode_packet
from resonator_daemon.board.session import probe as probe_module
from resonator_daemon.board.session.clock import Exchange
from resonator_daemon.board.session.probe import NoBoardError, probe, tick_rate

IDENTITY = Identity("board", "0042", "1.0", 0)
FRAME = encode_packet(0x90, 7, bytes(176), boot_id=5)


class Answering:
    """A link that answers each request with the same bytes, or with the request itself."""

    overruns = 0

    def __init__(self, says: bytes | None = None) -> None:
        self._says = says
        self._answers = b""

    def write(self, data: bytes) -> None:
        self._answers += data if self._says is None else self._says

    def read(self, timeout_s: float) -> bytes:
        if not self._answers:
            threading.Event().wait(timeout_s)  # as a port waits, without spinning
        answers, self._answers = self._answers, b""
        return answers

    def close(self) -> None: ...


class LossyLink(Answering):
    """A board that hears only some of what it is sent: those writes are lost whose numbers are given, from 0."""

    def __init__(self, lost: set[int], capabilities: int = Capability.LOCATE) -> None:
        super().__init__()
        description = Description(CounterKind.SINGLE_TONE, 4, 1, 10**12, 1, 2, "quartz16", capabilities=capabilities)
        self.board = DeviceSession(IDENTITY, description, boot_id=7)
        self._lost = lost
        self._writes = 0

    def write(self, data: bytes) -> None:
        if self._writes not in self._lost:
            self._answers += self.board.receive(data, 0)
        self._writes += 1


@pytest.mark.parametrize("lost", [set(), {0}, {1}, {2}, {3, 4}])
def test_what_is_lost_is_asked_again(lost: set[int]) -> None:
    link = LossyLink(lost)
    found = probe(link, blink=True)
    assert found.described.identity == IDENTITY
    assert found.refused_to_blink is None
    assert link.board.located
    assert not found.counting


def test_the_rate_is_that_between_the_quickest_exchanges_of_both_halves() -> None:
    exchanges = [
        Exchange(0, 0, 9_000),  # slow
        Exchange(1_000_000, 1_000_600, 1_001_000),
        Exchange(101_000_000, 101_010_700, 101_001_400),
        Exchange(102_000_000, 0, 102_900_000),  # slow
    ]
    rate = tick_rate(exchanges, 10**12)  # a tick a nanosecond
    elapsed_ns = 101_000_700 - 1_000_500
    assert rate.deviation_ppm == pytest.approx((101_010_700 - 1_000_600) / elapsed_ns * 1e6 - 1e6)
    assert rate.uncertainty_ppm == pytest.approx((1_000 + 1_400) / 2 / elapsed_ns * 1e6)


@pytest.mark.parametrize(
    ("says", "is_a_board", "why"),
    [
        (b"", False, "not a byte came"),
        (b"login: ", False, "bytes came and no packet among them"),
        (None, False, "only our own requests came back"),
        (encode_packet(0x81, 1, b"", boot_id=5, major=2), True, r"uses protocol 2, this program uses 1\.0"),
        (FRAME, True, "packets came"),
    ],
)
def test_who_does_not_identify_itself_is_told_with_what_came(
    says: bytes | None, is_a_board: bool, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probe_module, "ANSWER_S", 0.05)
    with pytest.raises(NoBoardError, match=why) as refused:
        probe(Answering(says))
    assert refused.value.is_a_board == is_a_board
