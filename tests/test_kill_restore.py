"""Parts of the system are killed and restored in random orders: it always converges; 200 orders in `make soak`."""

from pathlib import Path

from kill_restore import kill_and_restore
from system_parts import skin_system

# Of the test alone: on a machine that runs other tests meanwhile, starting a process takes seconds.
PATIENCE_S = 30.0


async def test_states_are_right_after_any_order(tmp_path: Path) -> None:
    result = await kill_and_restore(2, tmp_path, seed=1, systems=(skin_system,), converged_s=PATIENCE_S)
    assert result.wrong == []
    assert len(result.converged_s) == 2
    assert sum(result.kills.values()) >= 2
