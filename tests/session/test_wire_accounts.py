"""Every byte and frame in its place under each fault, and over the wrap of frame numbers; more of it in `make soak`."""

import pytest
from wire_accounts import CASES, Case, run

from resonator_daemon.session import frame_numbers as numbering
from simulators.faults import FaultPlan


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_accounts_are_exact(case: Case) -> None:
    assert run(case, 200 if case.chunk_bytes == 1 else 4000, seed=5) == []


def test_a_frame_in_the_wrong_place_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    as_counted = numbering.FrameNumbering._causes

    def one_too_few(it: numbering.FrameNumbering, missing: int) -> numbering.FrameLoss:
        return as_counted(it, max(0, missing - 1))

    monkeypatch.setattr(numbering.FrameNumbering, "_causes", one_too_few)
    assert run(Case("bit errors", FaultPlan(bit_error_rate=3e-5)), 2000, seed=5)
