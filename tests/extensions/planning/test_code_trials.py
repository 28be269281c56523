from dataclasses import replace

import numpy as np
import pytest

from resonator_daemon.extensions.planning.code_trials import (
    Codes,
    Scatter,
    draw_plate,
    nearest_wrong,
    one_touch,
    overlaps,
)

SCATTER = Scatter(
    force_max_newton=10.0, sensitivity_spread=0.0, tolerance=0.0, pulling=0.0, tempco_std=5e-8,
    temperature_span_kelvin=20.0, ageing=2e-6, model_error=0.015, counter_std=4.6e-10, oscillator_std=3.3e-9,
    common_std=2e-7, common_shift=0.0, tempco_difference_per_kelvin=0.0, noise_std=0.0
)  # fmt: skip


def ladder(step: float, sensitivity: np.ndarray) -> Codes:
    f0_hz = 10e6 * (1.0 - step * np.arange(1, len(sensitivity) + 1))
    return Codes(np.repeat(f0_hz[:, None], 4, axis=1), np.repeat(sensitivity[:, None], 4, axis=1))


def test_between_two_bands_a_common_shift_is_wrong_by_the_share_beyond_the_middle() -> None:
    # Two sites of 60 ppm, 100 ppm apart: 30 ppm off, tones within 10 ppm of a band's end are nearer to the other band.
    codes = ladder(100e-6, np.full(2, -6e-6))
    share = nearest_wrong(codes, 10.0, 30e-6, 400_000, np.random.default_rng(1)) / 400_000
    assert share == pytest.approx(10 / 60 / 2, abs=2e-3)


def test_sites_of_one_code_cannot_be_distinguished() -> None:
    codes = ladder(0.0, np.full(4, -6e-6))
    found = one_touch(codes, SCATTER, 2000, np.random.default_rng(2))
    assert found.right + found.wrong < 10
    assert overlaps(codes, SCATTER)


def test_a_ladder_overlaps_where_its_bands_do() -> None:
    # 1.02 x 60 ppm of force, 2 of ageing, 10 K of 1e-7 / K, 0.033 of noise, 2 x 1.5 % of 60 ppm.
    needed_ppm = 61.2 + 2.0 + 1.0 + 0.033 + 1.8
    for away_ppm, overlapping in ((-0.1, True), (0.1, False)):
        f0_hz = 10e6 * np.exp(-1e-6 * (needed_ppm + away_ppm) * np.arange(4))
        codes = Codes(np.repeat(f0_hz[:, None], 4, axis=1), np.full((4, 4), -6e-6))
        assert overlaps(codes, replace(SCATTER, tempco_difference_per_kelvin=1e-7)) is overlapping


def test_a_common_shift_that_matters_is_passed_to_the_matcher() -> None:
    codes = ladder(220e-6, np.full(8, -6.3e-6))
    unnoticed = replace(SCATTER, common_std=0.0, common_shift=20e-6)
    assert unnoticed.common_mode_std == pytest.approx(20e-6 / 3**0.5)
    found = one_touch(codes, unnoticed, 5000, np.random.default_rng(3))
    assert found.wrong == 0
    assert found.right > 0.9 * found.touches


def test_drawn_plates_stay_within_what_they_may_be_off_by() -> None:
    aimed = ladder(300e-6, np.full(300, -6e-6))
    scatter = replace(SCATTER, tolerance=20e-6, pulling=5e-6, sensitivity_spread=0.3)
    drawn = draw_plate(aimed, scatter, np.random.default_rng(5))
    off_ppm = 1e6 * (drawn.f0_hz / aimed.f0_hz - 1.0)
    place_ppm = off_ppm.mean(axis=1)
    assert 23.0 < np.abs(off_ppm).max() <= 25.0
    assert 18.0 < np.abs(place_ppm).max() <= 25.0
    assert 4.0 < np.abs(off_ppm - place_ppm[:, None]).max() <= 10.0
    ratio = drawn.sensitivity / aimed.sensitivity
    assert ratio.min() == pytest.approx(0.7, abs=0.01)
    assert ratio.max() == pytest.approx(1.3, abs=0.01)
    assert not np.ptp(ratio, axis=1).any()
