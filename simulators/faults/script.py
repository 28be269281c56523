"""What happens to board and link in the order of time, scripted or at random."""

import heapq
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


_SPANS = {
    "unplug": (Action.UNPLUG, Action.PLUG_IN),
    "freeze": (Action.FREEZE, Action.THAW),
    "silence": (Action.SILENCE, Action.RESUME),
}
_MOMENTS = {
    "reboot": Action.REBOOT,
    "brown_out": Action.BROWN_OUT,
    "rename": Action.RENAME,
    "tick_step": Action.STEP_TICKS,
}


class Script:
    """Gives one step after the other; random unplugs follow each other for ever."""

    def __init__(self, plan: FaultPlan, seed: int) -> None:
        self._random = np.random.default_rng((seed, 4))
        self._unplug_rate_hz, self._unplug_for_s = plan.unplug_rate_hz, plan.unplug_for_s
        steps = [step for event in plan.events for step in _steps(event)]
        self._heap = [(step.at_s, number, step) for number, step in enumerate(steps)]  # those at once in their order
        heapq.heapify(self._heap)
        self._random_steps = self._random_unplug(0.0)
        self.next_s = self._due_s()  # when the next step is due; None where nothing comes any more

    def pop(self) -> Step:
        """Remove and return the next step; there must be one."""
        step = self._next
        if step is None:
            raise LookupError("nothing comes any more")
        if self._random_steps and step is self._random_steps[0]:
            del self._random_steps[0]
            if not self._random_steps:
                self._random_steps = self._random_unplug(step.at_s)
        else:
            heapq.heappop(self._heap)
        self.next_s = self._due_s()
        return step

    def _due_s(self) -> float | None:
        step = self._next
        return None if step is None else step.at_s

    @property
    def _next(self) -> Step | None:
        scripted = self._heap[0][2] if self._heap else None
        at_random = self._random_steps[0] if self._random_steps else None
        if scripted is None or at_random is None:
            return scripted or at_random
        return min(scripted, at_random, key=lambda step: step.at_s)

    def _random_unplug(self, after_s: float) -> list[Step]:
        if not self._unplug_rate_hz:
            return []
        at_s = after_s + float(self._random.exponential(1.0 / self._unplug_rate_hz))
        return [Step(at_s, Action.UNPLUG), Step(at_s + self._unplug_for_s, Action.PLUG_IN)]


def _steps(event: FaultEvent) -> list[Step]:
    at_s, end_s = event.at_s, event.at_s + event.for_s
    if event.what in _SPANS:
        begin, end = _SPANS[event.what]
        return [Step(at_s, begin), Step(end_s, end)]
    if event.what in _MOMENTS:
        return [Step(at_s, _MOMENTS[event.what], event.to or "", event.ticks or 0)]
    return [
        Step(at_s, Action.TAKE_AWAY),
        Step(at_s + _SWAP_S, Action.PLUG_IN_OTHER),
        Step(end_s + _SWAP_S, Action.TAKE_AWAY),
        Step(end_s + 2.0 * _SWAP_S, Action.PLUG_IN_OWN),
    ]
