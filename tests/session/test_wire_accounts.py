"""Every byte and frame in its place under each fault, and over the wrap of frame numbers; more of it in `make soak`."""

from typing import Any

import pytest
from wire_accounts import CASES, Case, run

from resonator_daemon.session.frame_numbers import Accepted, FrameNumbering
from simulators.faults import FaultPlan


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_accounts_are_exact(case: Case) -> None:
    assert run(case, 200 if case.chunk_bytes == 1 else 4000, seed=5) == []


def test_a_frame_in_the_wrong_place_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    as_counted = FrameNumbering.accept

    def one_too_far(it: FrameNumbering, boot_id: int, sequence: int, *rest: Any) -> Accepted | None:
        accepted = as_counted(it, boot_id, sequence, *rest)
        if accepted is not None and accepted.gap is not None:
            accepted.index += 1
        return accepted

    monkeypatch.setattr(FrameNumbering, "accept", one_too_far)
    assert run(Case("bit errors", FaultPlan(bit_error_rate=3e-5)), 2000, seed=5)
