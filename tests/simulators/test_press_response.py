"""Hysteresis and creep against closed forms, a stop operator moved in small steps, and numerical integration."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp

from resonator_daemon.base.arrays import Floats
from simulators.press_response import PressResponse


def column(values: npt.ArrayLike) -> Floats:
    return np.asarray(values, dtype=np.float64)[:, np.newaxis]


def forces(gates: int, sites: int, seed: int) -> Floats:
    """Presses with reversals of all sizes, from far below the play to far above it."""
    random = np.random.default_rng(seed)
    return np.abs(np.cumsum(random.choice([-1, 1], (gates, sites)) * 0.2 * random.random((gates, sites)) ** 3, axis=0))


def test_the_play_is_the_force_less_a_stop_that_gives_way() -> None:
    force = forces(400, 3, seed=1)
    felt = PressResponse(3, 0.1, 0.0, 20.0).advance(1e-3, force)
    for site in range(3):
        stop, last = 0.0, 0.0
        for gate, now in enumerate(force[:, site]):
            for _ in range(50):  # small steps
                stop += (now - last) / 50
                stop = 0.1 if stop > 0.1 else -0.1 if stop < -0.1 else stop
            last = now
            assert felt[gate, site] == pytest.approx(now - stop / 2, abs=1e-12)


def test_creep_under_any_force_is_the_integral_of_its_differential_equation() -> None:
    force = forces(60, 1, seed=2)[:, 0]
    felt = PressResponse(1, 0.0, 0.3, 2.0).advance(0.1, column(force))[:, 0]
    crept = solve_ivp(
        lambda t, u: (force[min(int(t / 0.1), 59)] - u) / 2.0,
        (0, 6),
        [0.0],
        t_eval=(np.arange(60) + 0.5) * 0.1,
        max_step=1e-3,
        rtol=1e-8,
    ).y[0]
    assert felt == pytest.approx(0.7 * force + 0.3 * crept, abs=2e-4)
