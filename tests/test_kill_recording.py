"""A recorder that is killed leaves what it had flushed; 200 times in `make soak`."""

from pathlib import Path

from kill_recording import LOSS_AT_MOST_S, kill_and_read


def test_a_recorder_may_be_killed_at_any_moment(tmp_path: Path) -> None:
    result = kill_and_read(3, 1, tmp_path, recorded_s=0.6)
    assert result.wrong == []
    assert len(result.lost_s) + result.empty == 3
    assert len(result.lost_s) >= 1
    assert all(0 < lost_s <= LOSS_AT_MOST_S for lost_s in result.lost_s)
