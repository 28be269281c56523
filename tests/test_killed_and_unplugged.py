"""Parts that are killed and cables that are pulled, a few times: hundreds or thousands of times in `make soak`."""

from pathlib import Path

from hang_ups import hang_up
from kill_recording import LOSS_AT_MOST_S, kill_and_read
from kill_restore import kill_and_restore
from system_parts import skin_system

# Of the test alone: on a machine that runs other tests meanwhile, starting a process takes seconds.
PATIENCE_S = 30.0


def test_a_daemon_whose_cable_is_pulled_always_comes_back_and_leaks_nothing(tmp_path: Path) -> None:
    result = hang_up(3, tmp_path, seed=1)
    assert result.wrong == []
    assert result.lasting >= 2
    assert result.outages >= result.lasting


def test_a_recorder_may_be_killed_at_any_moment_and_leaves_what_it_had_flushed(tmp_path: Path) -> None:
    result = kill_and_read(3, 1, tmp_path, recorded_s=0.6)
    assert result.wrong == []
    assert len(result.lost_s) + result.empty == 3
    assert len(result.lost_s) >= 1
    assert all(0 < lost_s <= LOSS_AT_MOST_S for lost_s in result.lost_s)


async def test_states_are_right_after_parts_were_killed_and_restored_in_any_order(tmp_path: Path) -> None:
    result = await kill_and_restore(2, tmp_path, seed=1, systems=(skin_system,), converged_s=PATIENCE_S)
    assert result.wrong == []
    assert len(result.converged_s) == 2
    assert sum(result.kills.values()) >= 2
