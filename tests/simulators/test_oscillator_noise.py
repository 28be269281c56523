"""Oscillator noise as allantools and closed forms judge it."""

import allantools
import numpy as np
import pytest

from resonator_daemon.base.arrays import Floats
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
