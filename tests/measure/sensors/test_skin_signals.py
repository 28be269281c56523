import numpy as np
import pytest
from small_skin import SITES, TONES, Comb, dimensionless, some_signals

ALL = np.ones((4, TONES), dtype=bool)
EVEN = np.full((4, TONES), 0.03**2)


@pytest.mark.parametrize("common_mode", [0.0, 3e-5, -4e-5])
def test_signals_come_back_from_frequencies(common_mode):
    comb, physical = Comb(), some_signals()
    array = comb.array()
    signals, _ = array.signals(array.shifts(comb.offset_hz(physical, common_mode), EVEN), common_mode)
    assert signals == pytest.approx(dimensionless(physical), rel=1e-6, abs=1e-9)


def test_stated_noise_is_the_spread_and_no_corner_alone_does_better():
    comb, array, rng = Comb(), Comb().array(), np.random.default_rng(3)
    sigma = rng.uniform(0.01, 0.3, (4, TONES))
    offset = comb.offset_hz(some_signals())
    draws = []
    for _ in range(400):
        shifts = array.shifts(offset + sigma * rng.normal(size=sigma.shape), sigma**2)
        signals, noise_std = array.signals(shifts, 0.0)
        draws.append(signals)
    assert np.mean(np.std(draws, axis=0) / noise_std) == pytest.approx(1.0, abs=0.01)
    one = np.zeros((4, TONES), dtype=bool)
    one[0] = True
    assert (array.signals(array.shifts(offset, np.where(one, sigma**2, np.inf)), 0.0)[1] > noise_std).all()


def test_corners_that_are_not_known_are_left_out_and_tones_without_any_are_nan():
    comb, physical = Comb(), some_signals()
    array, offset = comb.array(), comb.offset_hz(physical)
    known = ALL.copy()
    known[:3, :50] = False
    known[:, 50:60] = False
    offset[~known] = 1e6
    signals, noise_std = array.signals(array.shifts(offset, np.where(known, EVEN, np.inf)), 0.0)
    lost = np.zeros((3, SITES), dtype=bool)
    lost[comb.signal_index[50:60], comb.site_index[50:60]] = True
    assert (np.isnan(signals) == lost).all()
    assert (np.isnan(noise_std) == lost).all()
    assert signals[~lost] == pytest.approx(dimensionless(physical)[~lost], rel=1e-6, abs=1e-9)


def test_a_signal_that_the_plate_does_not_sense_is_nan():
    comb = Comb()
    keep = comb.signal_index != 1
    array = comb.array(
        **{name: getattr(comb, name)[keep] for name in ("f0_hz", "sensitivity", "oscillator_hz")},
        site_index=comb.site_index[keep],
        signal_index=comb.signal_index[keep],
    )
    shifts = array.shifts(comb.offset_hz(some_signals())[:, keep], EVEN[:, keep])
    signals, _ = array.signals(shifts, 0.0)
    assert np.isnan(signals[1]).all()
    assert np.isfinite(signals[[0, 2]]).all()


def noisy(comb, array, physical, common_mode, seed, known=ALL):
    noise = 0.03 * np.random.default_rng(seed).normal(size=(4, TONES))
    return array.shifts(comb.offset_hz(physical, common_mode) + noise, np.where(known, EVEN, np.inf))


def test_one_bad_tone_does_not_pass_for_a_touch():
    comb, array = Comb(), Comb().array()
    offset = comb.offset_hz(np.zeros((3, SITES)), 1e-5)
    offset[:, 7] += 500.0
    assert array.untouched_common_mode(array.shifts(offset, EVEN)) == pytest.approx(1e-5, abs=1e-12)


@pytest.mark.parametrize("pressed", [slice(0, SITES), slice(0, 6)])
def test_a_touch_of_a_few_sites_or_of_the_whole_plate_is_told(pressed):
    comb, array = Comb(), Comb().array()
    physical = np.zeros((3, SITES))
    physical[0, pressed] = 1e3
    assert array.untouched_common_mode(noisy(comb, array, physical, 1e-5, 1)) is None


def test_too_few_tones_do_not_tell():
    comb, array = Comb(), Comb().array()
    known = np.zeros((4, TONES), dtype=bool)
    known[1, :15] = True
    assert array.untouched_common_mode(noisy(comb, array, np.zeros((3, SITES)), 0.0, 1, known)) is None
    known[1, :16] = True
    assert array.untouched_common_mode(noisy(comb, array, np.zeros((3, SITES)), 0.0, 1, known)) is not None
