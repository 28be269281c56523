"""Every byte and frame in its place under each fault, and over the wrap of frame numbers; more of it in `make soak`."""

import pytest
from wire_accounts import CASES, Case, run


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_accounts_are_exact(case: Case) -> None:
    assert run(case, 200 if case.chunk_bytes == 1 else 4000, seed=5) == []
