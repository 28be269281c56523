from dataclasses import replace

import numpy as np
import pytest

from resonator_daemon.extensions.planning.code_ladder import Tolerances
from resonator_daemon.extensions.planning.code_trials import Codes, draw_plate, one_touch, overlaps

TOLERANCES = Tolerances(
    force_max_newton=10.0, temperature_span_kelvin=20.0, tempco_std=5e-8, tempco_difference_per_kelvin=0.0,
    ageing=2e-6, pulling=0.0, placement=0.0, sensitivity_spread=0.0, model_error=0.015, counter_std=4.6e-10,
    oscillator_std=3.3e-9
)  # fmt: skip


def ladder(step: float, sensitivity: np.ndarray) -> Codes:
    f0_hz = 10e6 * np.exp(-step * np.arange(len(sensitivity)))
    return Codes(np.repeat(f0_hz[:, None], 4, axis=1), np.repeat(sensitivity[:, None], 4, axis=1))


def test_touches_are_right_where_codes_are_apart_and_undecided_where_they_are_one() -> None:
    found = one_touch(ladder(0.0, np.full(4, -6e-6)), TOLERANCES, 2000, np.random.default_rng(2))
    assert found.right + found.wrong < 10
    assert overlaps(ladder(0.0, np.full(4, -6e-6)), TOLERANCES)
    found = one_touch(ladder(220e-6, np.full(8, -6.3e-6)), TOLERANCES, 2000, np.random.default_rng(3))
    assert found.wrong == 0
    assert found.right > 0.9 * found.touches


def test_a_ladder_overlaps_where_its_bands_do() -> None:
    # 1.02 x 60 ppm of force, 2 of ageing, 10 K of 1e-7 / K, 0.033 of noise, 2 x 1.5 % of 60 ppm.
    needed_ppm = 61.2 + 2.0 + 1.0 + 0.033 + 1.8
    for away_ppm, overlapping in ((-0.1, True), (0.1, False)):
        codes = ladder(1e-6 * (needed_ppm + away_ppm), np.full(4, -6e-6))
        assert overlaps(codes, replace(TOLERANCES, tempco_difference_per_kelvin=1e-7)) is overlapping


def test_drawn_plates_stay_within_what_they_may_be_off_by() -> None:
    aimed = ladder(300e-6, np.full(300, -6e-6))
    tolerances = replace(TOLERANCES, placement=20e-6, pulling=5e-6, sensitivity_spread=0.3)
    drawn = draw_plate(aimed, tolerances, np.random.default_rng(5))
    off_ppm = 1e6 * (drawn.f0_hz / aimed.f0_hz - 1.0)
    place_ppm = off_ppm.mean(axis=1)
    assert 23.0 < np.abs(off_ppm).max() <= 25.0
    assert 18.0 < np.abs(place_ppm).max() <= 25.0
    assert 4.0 < np.abs(off_ppm - place_ppm[:, None]).max() <= 10.0
    ratio = drawn.sensitivity / aimed.sensitivity
    assert ratio.min() == pytest.approx(0.7, abs=0.01)
    assert ratio.max() == pytest.approx(1.3, abs=0.01)
    assert not np.ptp(ratio, axis=1).any()
