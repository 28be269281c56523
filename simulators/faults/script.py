"""What happens to board and link in the order of time, scripted or at random."""

import heapq
from collections.abc import Iterator
from enum import Enum
from typing import NamedTuple

import numpy as np

from simulators.faults.plan import FaultEvent, FaultPlan

_SWAP_S = 0.1  # between one board's leaving the port and the next one's coming


class Action(Enum):
    """One thing to do."""

    UNPLUG = "unplug"
    PLUG_IN = "plug in"
    RENAME = "rename"
    FREEZE = "freeze"
    THAW = "thaw"
    SILENCE = "silence"
    RESUME = "resume"
    REBOOT = "reboot"
    BROWN_OUT = "brown out"
    STEP_TICKS = "step ticks"
    TAKE_AWAY = "take away"  # unplugs a board to plug another in
    PLUG_IN_OTHER = "plug in other"
    PLUG_IN_OWN = "plug in own"


class Step(NamedTuple):
    """An action at a time since the first START, with what it needs."""

    at_s: float
    action: Action
    to: str = ""
    ticks: int = 0


_ACTIONS = {
    "unplug": (Action.UNPLUG, Action.PLUG_IN),
    "freeze": (Action.FREEZE, Action.THAW),
    "silence": (Action.SILENCE, Action.RESUME),
    "reboot": (Action.REBOOT,),
    "brown_out": (Action.BROWN_OUT,),
    "rename": (Action.RENAME,),
    "tick_step": (Action.STEP_TICKS,),
}


class Script:
    """Steps in the order of time, those at once in the order of the plan; random unplugs follow each other for ever.

    `next_s` is when the next step is due, None after the last one.
    """

    def __init__(self, plan: FaultPlan, seed: int) -> None:
        planned = sorted((step for event in plan.events for step in _steps(event)), key=_at_s)
        self._steps = heapq.merge(planned, _random_unplugs(plan, seed), key=_at_s)
        self._advance()

    def pop(self) -> Step:
        """Remove and return the next step; there must be one."""
        step = self._next
        if step is None:
            raise LookupError("the script is at its end")
        self._advance()
        return step

    def _advance(self) -> None:
        self._next = next(self._steps, None)
        self.next_s = None if self._next is None else self._next.at_s


def _at_s(step: Step) -> float:
    return step.at_s


def _random_unplugs(plan: FaultPlan, seed: int) -> Iterator[Step]:
    random, at_s = np.random.default_rng((seed, 4)), 0.0
    while plan.unplug_rate_hz:
        at_s += float(random.exponential(1.0 / plan.unplug_rate_hz))
        yield Step(at_s, Action.UNPLUG)
        at_s += plan.unplug_for_s
        yield Step(at_s, Action.PLUG_IN)


def _steps(event: FaultEvent) -> list[Step]:
    at_s, end_s = event.at_s, event.at_s + event.for_s
    if event.what == "wrong_board":
        return [
            Step(at_s, Action.TAKE_AWAY),
            Step(at_s + _SWAP_S, Action.PLUG_IN_OTHER),
            Step(end_s + _SWAP_S, Action.TAKE_AWAY),
            Step(end_s + 2.0 * _SWAP_S, Action.PLUG_IN_OWN),
        ]
    begin_and_end = zip((at_s, end_s), _ACTIONS[event.what], strict=False)
    return [Step(time_s, action, event.to or "", event.ticks or 0) for time_s, action in begin_and_end]
