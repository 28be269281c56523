"""Oscillator noise as allantools and closed forms judge it."""

import math

import allantools
import numpy as np
import pytest

from resonator_daemon.arrays import Floats
from simulators.oscillator_noise import OscillatorNoise

S = 1.0  # Allan deviation at 1 s of whatever is on; all is linear in it


def oscillators(count: int, white_fm: float, flicker_fm: float, random_walk_fm: float, seed: int) -> OscillatorNoise:
    return OscillatorNoise(count, white_fm, flicker_fm, random_walk_fm, np.random.default_rng(seed))


def overlapping_allan_deviation(shift: Floats, dt_s: float, spans: tuple[int, ...]) -> Floats:
    """Of the mean Allan variance over the oscillators, shift (gates, oscillators)."""
    taus = np.array(spans) * dt_s
    deviations = [allantools.oadev(column, 1 / dt_s, data_type="freq", taus=taus)[1] for column in shift.T]
    return np.sqrt(np.mean(np.square(deviations), axis=0))


@pytest.mark.parametrize("dt_s", [1e-3, 5e-3])
@pytest.mark.parametrize(
    ("levels", "slope"),
    [((S, 0.0, 0.0), -0.5), ((0.0, S, 0.0), 0.0), ((0.0, 0.0, S), 0.5)],
    ids=["white", "flicker", "random walk"],
)
def test_allan_deviations_have_their_slope_and_level(
    levels: tuple[float, float, float], slope: float, dt_s: float
) -> None:
    spans = (1, 2, 4, 8, 16, 32, 64, 128, 256)
    shift = oscillators(48, *levels, seed=1).advance(dt_s, 2**14).relative_shift
    tau_s = np.array(spans) * dt_s
    deviation = overlapping_allan_deviation(shift, dt_s, spans)
    assert deviation == pytest.approx(S * tau_s**slope, rel=0.05)
    assert np.polyfit(np.log(tau_s), np.log(deviation), 1)[0] == pytest.approx(slope, abs=0.02)


def test_a_regression_over_gates_sees_white_fm_as_in_a_finely_made_phase() -> None:
    """Against a random walk of the phase in 500 steps a gate, over one gate and over ten that are merged."""
    dt_s, gates, steps, runs = 1e-3, 10, 500, 2_000
    random = np.random.default_rng(5)
    increments = S * math.sqrt(dt_s / steps) * random.standard_normal((runs, gates * steps))
    phase_s = np.cumsum(increments, axis=1).astype(np.float64)
    t_s = (np.arange(gates * steps) + 1) * dt_s / steps
    one, ten = t_s[:steps] - t_s[:steps].mean(), t_s - t_s.mean()
    made_one, made_ten = phase_s[:, :steps] @ one / (one @ one), phase_s @ ten / (ten @ ten)

    noise = oscillators(4_000, S, 0.0, 0.0, seed=6).advance(dt_s, gates)
    slope = noise.relative_shift + noise.regression_excess
    ends_s = np.cumsum(noise.relative_shift, axis=0) * dt_s
    mean_s = ends_s - noise.relative_shift * dt_s / 2 + noise.phase_mean_s
    middle_s = (np.arange(gates)[:, np.newaxis] - (gates - 1) / 2) * dt_s
    # Sums of products about the middle of ten gates: between the gates' means, and within each gate.
    ours = (middle_s * mean_s + slope * dt_s**2 / 12).sum(axis=0) / (gates * (gates * dt_s) ** 2 / 12)

    assert slope.std() == pytest.approx(made_one.std(), rel=0.04)
    assert ours.std() == pytest.approx(made_ten.std(), rel=0.04)
    # Rubiola, Lenczner, Bourgeois, Vernotte, "The Omega Counter" (2016): 1.2 times the variance between the ends.
    assert slope.var() == pytest.approx(1.2 * S**2 / dt_s, rel=0.03)
    assert ours.var() == pytest.approx(1.2 * S**2 / (gates * dt_s), rel=0.05)
    bridges_s = phase_s[:, :steps] - phase_s[:, steps - 1 : steps] * t_s[:steps] / dt_s
    assert noise.phase_mean_s.std() == pytest.approx(bridges_s.mean(axis=1).std(), rel=0.04)
