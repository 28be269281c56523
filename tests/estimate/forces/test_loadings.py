from itertools import pairwise

import numpy as np
import pytest

from resonator_daemon.estimate.forces.loadings import Readings, Steps, felt_newton

MASS_NEWTON = np.array([0.5, 1.0, 4.0])


def steps_of(site, since_s, pressing):
    count = len(site)
    return Steps(
        np.array(site), np.array(since_s, float), np.array(pressing, bool), np.zeros(count), np.full(count, 298.15)
    )


def readings_of(step, time_s, **changed):
    columns = {
        "shift": np.zeros((len(step), 4)),
        "noise_std": np.full((len(step), 4), 1e-9),
        "oscillator_std": np.zeros(len(step)),
    }
    return Readings(np.array(step), np.array(time_s, float), **(columns | changed))


def brute_force(times_s, forces_newton, at_s, h, c, tau_s):
    """Play and creep in steps of 0.5 ms, along a ramp of 20 ms to each new load."""
    time_s = np.arange(0.0, at_s + 2.5e-4, 5e-4)
    ramp_s = np.ravel([[t, t + 0.02] for t in times_s])
    force = np.interp(time_s, ramp_s, np.ravel([[0, forces_newton[0]], *pairwise(forces_newton)]))
    play = creep = 0.0
    for newton in force.tolist():
        play = newton - h if newton - play > h else newton + h if play - newton > h else play
        creep += 5e-4 * (newton - creep) / tau_s
    return (newton + play) / 2 * (1 - c) + c * creep


def test_what_sites_felt_is_that_of_play_and_creep_in_small_steps():
    # Two sites whose steps interleave, up and down, with one small step that the play swallows.
    pressing = [[1, 0, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1], [0, 0, 0], [0, 1, 0], [0, 0, 1]]
    steps = steps_of([0, 1, 0, 0, 0, 1, 0], [0, 3, 10, 22, 30, 31, 40], pressing)
    readings = readings_of([0, 1, 2, 3, 3, 5, 6], [5, 7, 15, 23, 29, 45, 41])
    forces = steps.pressing @ MASS_NEWTON
    felt = felt_newton(steps, forces, readings, 0.3, 0.02, 12.0)
    for index, step in enumerate(readings.step):
        before = (steps.site == steps.site[step]) & (steps.since_s <= steps.since_s[step])
        expected = brute_force(steps.since_s[before], forces[before], readings.time_s[index], 0.3, 0.02, 12.0)
        assert felt[index] == pytest.approx(expected, abs=2e-4)
    assert np.ptp(felt - forces[readings.step]) > 0.1
