"""The line between a board and its link; time passes by hand."""

import numpy as np
import pytest

from simulators.faults import FaultPlan
from simulators.faults.account import FaultCounts
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


@pytest.mark.parametrize("kind", ["answer", "frame"])
def test_a_late_one_is_passed_by_others_and_counted(kind: str) -> None:
    late = line(**{f"{kind}_delay_rate": 0.1, f"{kind}_delay_ms": 50.0})
    arrived: list[tuple[int, int]] = []
    counts = FaultCounts()
    for now_ms in range(2100):
        if now_ms < 2000:
            for is_frame in (False, True):
                number = 2 * now_ms + is_frame
                harm = FaultCounts(packets_hit=1)
                late.put(Lot(str(number).encode(), is_frame, harm), now_ms * MS, now_ms if is_frame else None)
        while (lot := late.pop(now_ms * MS)) is not None:
            arrived.append((now_ms, int(lot.data)))
            counts.add(lot.harm or FaultCounts())
    numbers = [number for _, number in arrived]
    lateness = {number: at_ms - number // 2 for at_ms, number in arrived}
    assert sorted(numbers) == list(range(4000))
    is_frame = kind == "frame"
    delayed = sorted(number for number, ms in lateness.items() if ms)
    assert set(lateness.values()) == {0, 50}
    assert all(number % 2 == is_frame for number in delayed)
    assert len(delayed) == pytest.approx(200, abs=50)
    assert counts.answers_delayed + counts.frames_delayed == len(delayed)
    assert sorted(counts.frame_sequences_delayed) == ([number // 2 for number in delayed] if is_frame else [])
    assert counts.packets_hit == 4000  # what was done before is not forgotten
    in_time = [number for number in numbers if not lateness[number]]
    assert in_time == sorted(in_time)


def test_pieces_are_of_any_length_up_to_the_longest() -> None:
    splitter = Splitter(FaultPlan(split_bytes=7), 1)
    lengths = [splitter.piece_bytes(100, 0) for _ in range(500)]
    assert set(lengths) == set(range(1, 8))
    assert splitter.piece_bytes(3, 0) <= 3
    assert splitter.next_ns is None
    assert Splitter(FaultPlan(), 1).unlimited
    assert {Splitter(FaultPlan(split_bytes=1), 1).piece_bytes(9, 0) for _ in range(9)} == {1}


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
