"""Steps of a script: in the order of time, and at random as often as asked for."""

import numpy as np
import pytest

from simulators.faults import FaultEvent, FaultPlan
from simulators.faults.script import Action, Script


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
