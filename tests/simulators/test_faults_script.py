"""Steps of a script: in the order of time, and at random as often as asked for."""

import numpy as np
import pytest

from simulators.faults import FaultEvent, FaultPlan
from simulators.faults.script import Action, Script, Step


def all_steps(plan: FaultPlan) -> list[Step]:
    script = Script(plan, 1)
    steps = []
    while script.next_s is not None:
        steps.append(script.pop())
        assert script.next_s is None or script.next_s >= steps[-1].at_s
    return steps


def test_every_event_has_its_steps_in_the_order_of_time() -> None:
    events = (
        FaultEvent(at_s=9.0, what="tick_step", ticks=-5),
        FaultEvent(at_s=1.0, what="unplug", for_s=3.0),
        FaultEvent(at_s=2.0, what="freeze", for_s=0.5),
        FaultEvent(at_s=2.2, what="silence", for_s=0.1),
        FaultEvent(at_s=4.0, what="reboot"),
        FaultEvent(at_s=4.0, what="brown_out"),
        FaultEvent(at_s=8.0, what="rename", to="b"),
    )
    assert all_steps(FaultPlan(events=events)) == [
        Step(1.0, Action.UNPLUG),
        Step(2.0, Action.FREEZE),
        Step(2.2, Action.SILENCE),
        Step(pytest.approx(2.3), Action.RESUME),
        Step(2.5, Action.THAW),
        Step(4.0, Action.PLUG_IN),
        Step(4.0, Action.REBOOT),
        Step(4.0, Action.BROWN_OUT),
        Step(8.0, Action.RENAME, to="b"),
        Step(9.0, Action.STEP_TICKS, ticks=-5),
    ]


def test_random_unplugs_follow_each_other_and_mix_with_the_script() -> None:
    plan = FaultPlan(unplug_rate_hz=2.0, unplug_for_s=0.1, events=(FaultEvent(at_s=50.0, what="reboot"),))
    script = Script(plan, 3)
    steps = [script.pop() for _ in range(2001)]
    assert [step.at_s for step in steps] == sorted(step.at_s for step in steps)
    (reboot,) = [step for step in steps if step.action is Action.REBOOT]
    assert reboot.at_s == 50.0
    pulls = np.array([step.at_s for step in steps if step.action is Action.UNPLUG])
    returns = np.array([step.at_s for step in steps if step.action is Action.PLUG_IN])
    assert returns - pulls == pytest.approx(0.1)
    gaps = np.diff(pulls) - 0.1
    assert gaps.min() > 0.0
    assert gaps.mean() == pytest.approx(0.5, rel=0.1)
    assert gaps.std() == pytest.approx(0.5, rel=0.15)
    again = Script(plan, 3)
    assert [again.pop() for _ in range(100)] == steps[:100]
