import logging
from dataclasses import dataclass, field

import pytest

from resonator_daemon.base.reasons import Condition
from resonator_daemon.daemon.monitoring.liveness import LivenessMonitor

WAITING = (Condition.WAITING, Condition.STALLED, Condition.LOST, Condition.REFUSED)


@dataclass
class Course:
    """A watch whose clock goes on by a second with each question."""

    now_s: float = 0.0
    frames: int = 0
    turns: int = 0
    watch: LivenessMonitor = field(init=False)

    def __post_init__(self) -> None:
        self.watch = LivenessMonitor(lambda: self.now_s)

    def healthy_s(self, state: Condition, seconds: int, *, frames: bool, turns: bool) -> int:
        """For how many seconds of those given the watch found it well."""
        well = 0
        for _ in range(seconds):
            self.now_s += 1
            self.frames += 100 * frames
            self.turns += 50 * turns
            well += self.watch.healthy(self.frames, state, self.turns)
        return well


@pytest.mark.parametrize("state", WAITING)
def test_a_declared_wait_lasts_as_long_as_it_is_tried(state: Condition) -> None:
    course = Course()
    assert course.healthy_s(state, 1000, frames=False, turns=True) == 1000
    assert course.healthy_s(state, 1000, frames=False, turns=False) == 60


def test_a_reader_that_stands_still_is_found_though_old_frames_are_measured() -> None:
    assert Course().healthy_s(Condition.ONLINE, 1000, frames=True, turns=False) == 60


def test_the_first_frame_has_its_time_after_a_long_wait() -> None:
    course = Course()
    course.healthy_s(Condition.WAITING, 1000, frames=False, turns=True)
    assert course.healthy_s(Condition.ONLINE, 8, frames=False, turns=True) == 8
    assert course.healthy_s(Condition.ONLINE, 100, frames=True, turns=True) == 100


def test_what_goes_on_again_is_well(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    course = Course()
    assert course.healthy_s(Condition.ONLINE, 50, frames=False, turns=True) == 10
    assert course.healthy_s(Condition.ONLINE, 50, frames=True, turns=True) == 50
    assert [record.levelname for record in caplog.records] == ["ERROR", "INFO"]
    assert course.healthy_s(Condition.ONLINE, 100, frames=False, turns=True) == 10
    assert "no frame was measured for 11 s (limit 10 s), link online" in caplog.messages[0]
