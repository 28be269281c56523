"""The line between a board and its link; time passes by hand."""

import numpy as np
import pytest

from simulators.faults import FaultPlan
from simulators.faults.timing import Line, Lot, Splitter

MS = 1_000_000


def line(seed: int = 1, **faults: float) -> Line:
    return Line(FaultPlan.model_validate(faults), seed)


def lots_due(held: Line, now_ns: int) -> list[bytes]:
    return [lot.data for lot in iter(lambda: held.pop(now_ns), None)]


def test_clumps_leave_whole_at_multiples_of_their_time() -> None:
    clumped = line(clump_ms=16.0, delay_ms=2.0)
    for now_ms in range(40):
        clumped.put(Lot(bytes([now_ms]), frames=1), now_ms * MS)
    leave = {now_ms: lots_due(clumped, now_ms * MS) for now_ms in range(0, 49)}
    assert {now_ms: [len(lot) for lot in lots] for now_ms, lots in leave.items() if lots} == {
        16: [15],
        32: [16],
        48: [9],
    }
    assert b"".join(b"".join(lots) for lots in leave.values()) == bytes(range(40))
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
