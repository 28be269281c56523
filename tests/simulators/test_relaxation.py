"""First-order lag against the exponential and against numerical integration."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from simulators.relaxation import Relaxation


def test_targets_that_change_are_followed_as_the_differential_equation_is() -> None:
    dt_s, time_s = 0.3, 2.0
    targets = np.random.default_rng(1).normal(size=40)
    ours = Relaxation(time_s, np.array([0.7])).advance(dt_s, targets[:, np.newaxis])[:, 0]
    now, middles = 0.7, []
    for target in targets:
        run = solve_ivp(
            lambda _, x, target=target: (target - x) / time_s, (0, dt_s), [now], t_eval=[dt_s / 2, dt_s], rtol=1e-10
        )
        middles.append(run.y[0, 0])
        now = run.y[0, 1]
    assert ours == pytest.approx(np.array(middles), abs=1e-7)
