"""Parts of the system are killed and restored in random orders: it always converges; 200 orders in `make soak`."""

from pathlib import Path

import pytest
from kill_restore import Holdings, Result, kill_and_restore
from system_parts import skin_system

pytestmark = pytest.mark.undisturbed

# Of the test alone: on a machine that runs other tests meanwhile, starting a process takes seconds.
PATIENCE_S = 30.0


async def test_states_are_right_after_any_order(tmp_path: Path) -> None:
    result = await kill_and_restore(2, tmp_path, seed=1, systems=(skin_system,), converged_s=PATIENCE_S)
    assert result.wrong == []
    assert len(result.converged_s) == 2
    assert sum(result.kills.values()) >= 2


def test_what_leaks_in_a_survivor_is_found_and_a_restored_part_begins_anew() -> None:
    result = Result()
    holdings = Holdings(result)
    held = {"tasks": 7.0, "threads": 6.0, "file_descriptors": 20.0, "rss_mb": 90.0}
    for run in range(3):
        holdings.take("daemon", 4711, held | {"threads": 6.0 + run, "rss_mb": 90.0 + run})
    holdings.take("daemon", 4712, held | {"file_descriptors": 30.0})  # another process
    assert result.wrong == []
    assert result.longest_survival == 2
    holdings.take("daemon", 4711, held | {"tasks": 8.0})
    holdings.take("daemon", 4712, held | {"file_descriptors": 34.0})
    assert result.wrong == [
        "daemon holds 1 more of tasks after 3 runs",
        "daemon holds 4 more of file_descriptors after 1 runs",
    ]
