"""Contacts are given up when frames have not come for half a second."""

from collections.abc import Callable

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.measure.pipeline.board_pipeline import CONTACTS_END_S, FrameTimeout

NO_FRAMES = Reason(ReasonCode.NO_FRAMES, "no frames for 0.5 s")


class Loop:
    """Time that passes when told."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.due: list[tuple[float, Callable[..., None], tuple[object, ...]]] = []

    @property
    def utc_ns(self) -> int:
        return round(self.now_s * 1e9)

    def call_later(self, delay_s: float, callback: Callable[..., None], *arguments: object) -> "Loop":
        self.due = [(self.now_s + delay_s, callback, arguments)]
        return self

    def cancel(self) -> None:
        self.due.clear()

    def pass_by(self, seconds: float) -> None:
        self.now_s += seconds
        for at_s, callback, arguments in list(self.due):
            if at_s <= self.now_s:
                self.due.clear()
                callback(*arguments)


def watched() -> tuple[Loop, FrameTimeout, list[Reason]]:
    loop, said = Loop(), []
    return loop, FrameTimeout(said.append, loop.call_later), said


def test_a_link_that_stays_away_is_told_of_once() -> None:
    loop, timeout, said = watched()
    timeout.watch("online", loop.utc_ns)
    timeout.watch("lost", loop.utc_ns)
    loop.pass_by(0.9 * CONTACTS_END_S)
    timeout.watch("waiting", loop.utc_ns)
    loop.pass_by(0.05 * CONTACTS_END_S)
    assert said == []
    loop.pass_by(0.1 * CONTACTS_END_S)
    loop.pass_by(10 * CONTACTS_END_S)
    timeout.watch("waiting", loop.utc_ns)
    loop.pass_by(10 * CONTACTS_END_S)
    assert said == [NO_FRAMES]


def test_a_link_that_comes_back_in_time_is_not_told_of() -> None:
    loop, timeout, said = watched()
    for _ in range(3):
        timeout.watch("stalled", loop.utc_ns)
        loop.pass_by(0.9 * CONTACTS_END_S)
        timeout.watch("online", loop.utc_ns)
        loop.pass_by(5 * CONTACTS_END_S)
    assert said == []


def test_without_an_event_loop_what_passes_is_told() -> None:
    said: list[str] = []
    timeout = FrameTimeout(said.append, None)
    timeout.watch("lost", 1_000_000_000)
    timeout.passed(1_499_999_999)
    assert said == []
    timeout.passed(1_500_000_000)
    timeout.passed(9_000_000_000)
    assert said == [NO_FRAMES]


def test_a_link_that_comes_back_late_is_told_of_first_even_if_the_loop_slept_meanwhile() -> None:
    loop, timeout, said = watched()
    timeout.watch("lost", 1_000_000_000)
    timeout.watch("online", 1_600_000_000)
    assert said == [NO_FRAMES]
    loop.pass_by(CONTACTS_END_S)
    assert len(said) == 1
    timeout.watch("stalled", 2_000_000_000)
    loop.pass_by(CONTACTS_END_S)
    assert len(said) == 2
