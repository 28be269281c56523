import numpy as np
import pytest

from resonator_daemon.estimate.forces.force_tones import ForceTones

# Tones in the order of frequency; sites 2, 0, 1, of which 0 and 2 have a thermometer, too.
SITE = np.array([2, 0, 0, 2, 1])
SIGNAL = np.array([0, 1, 0, 1, 0])
FORCE_TONE = {0: 2, 1: 4, 2: 0}
WARM_TONE = {0: 1, 2: 3}
PULL = np.array([0.0, 2e-5, -1e-5, 1.5e-5])
F0_HZ = (9.9e6 + 4000.0 * np.arange(5))[:, None] * (1 + PULL)
SENSITIVITY = np.where(SIGNAL == 0, -6e-6, 9e-6)[:, None] * np.array([1.0, 1.2, 0.8, 1.1])
SENSITIVITY[4] *= -1  # site 1: a press raises its frequency
OSCILLATOR_HZ = 9.9e6 + 4000.0 * np.arange(5) + 37.0
SIGMA = np.full((4, 5), 0.01)


def tones():
    return ForceTones(F0_HZ, SENSITIVITY, OSCILLATOR_HZ, SITE, SIGNAL)


def offsets_hz(force=(0.0, 0.0, 0.0), warmer=(0.0, 0.0, 0.0)):
    """Offsets (4, t): force tones by (f - f0) / f = K F, temperature tones by f = f0 (1 + s d)."""
    hz = np.empty((5, 4))
    for tone, (site, signal) in enumerate(zip(SITE, SIGNAL, strict=True)):
        k = SENSITIVITY[tone]
        hz[tone] = F0_HZ[tone] * (1 + k * warmer[site]) if signal else F0_HZ[tone] / (1 - k * force[site])
    return hz.T - OSCILLATOR_HZ


def test_forces_come_back_site_by_site_whatever_the_order_of_the_tones():
    force = np.array([1.5, 4.0, 0.25])
    shifts = tones().shifts(offsets_hz(force), SIGMA)
    assert shifts.shift / shifts.sensitivity == pytest.approx(force, rel=1e-6)
    assert shifts.shift[1] > 0 > shifts.shift[0]


def test_thermometers_tell_kelvin_where_there_are_any():
    shifts = tones().shifts(offsets_hz(warmer=(7.0, 3.0, -2.0)), SIGMA)
    assert shifts.kelvin[[0, 2]] == pytest.approx([7.0, -2.0], rel=1e-4)
    assert np.isnan(shifts.kelvin[1])
    assert shifts.shift == pytest.approx(np.zeros(3), abs=1e-12)


def test_corners_count_by_their_variance():
    rng = np.random.default_rng(0)
    sigma = np.array([0.02, 0.05, 0.3, 2.0])[:, None] * np.ones(5)
    draws = [tones().shifts(offsets_hz() + sigma * rng.standard_normal((4, 5)), sigma) for _ in range(4000)]
    scatter = np.std([draw.shift for draw in draws], axis=0)
    best = 1 / np.sqrt((1 / (sigma[:, 0] / 9.9e6) ** 2).sum())  # no unbiased mean has less
    assert scatter == pytest.approx(np.full(3, best), rel=0.05)
    assert np.sqrt(draws[0].variance) == pytest.approx(np.full(3, best), rel=3e-3)
    assert np.mean([draw.shift for draw in draws], axis=0) == pytest.approx(np.zeros(3), abs=5 * best / 4000**0.5)


def test_corners_that_are_not_known_are_left_out():
    force = np.array([1.5, 4.0, 0.25])
    sigma, offset = SIGMA.copy(), offsets_hz(force)
    offset[0, FORCE_TONE[0]] = np.nan
    sigma[1, FORCE_TONE[0]] = np.nan
    sigma[2, FORCE_TONE[0]] = 0.0
    offset[2, FORCE_TONE[0]] = 300.0  # of no weight
    shifts = tones().shifts(offset, sigma)
    assert shifts.shift / shifts.sensitivity == pytest.approx(force, rel=1e-6)
    assert shifts.sensitivity[0] == SENSITIVITY[FORCE_TONE[0], 3]
    assert shifts.variance[0] == pytest.approx(4 * shifts.variance[1], rel=0.01)


def test_a_site_that_no_corner_hears_is_not_known_and_leaves_the_others():
    offset = offsets_hz((1.0, 1.0, 1.0))
    offset[:, FORCE_TONE[2]] = np.nan
    shifts = tones().shifts(offset, SIGMA)
    assert np.isnan([shifts.shift[2], shifts.variance[2]]).all()
    assert np.isfinite(shifts.shift[:2]).all()
    assert shifts.kelvin[2] == pytest.approx(0.0, abs=1e-6)
    offset[:, WARM_TONE[2]] = np.nan
    assert np.isnan(tones().shifts(offset, SIGMA).kelvin[2])
