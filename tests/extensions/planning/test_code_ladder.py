import math

import numpy as np
import pytest

from resonator_daemon.extensions.planning.code_ladder import Limits, force_noise, guard_band, stamp_noise

LIMITS = Limits(
    force_max_newton=10.0, temperature_span_kelvin=20.0, tempco_difference_per_kelvin=3e-7, ageing=2e-6,
    noise_std=1e-6, pulling=25e-6, tolerance=15e-6, common_shift=10e-6
)  # fmt: skip


@pytest.mark.parametrize(
    ("factors", "force_ppm"),
    [
        (np.array([[-8.1] * 4, [5.0] * 4]), 131.0),  # both signs on a channel: bands grow towards each other
        (np.array([[-8.1, 5.0, -8.1, 5.0]] * 2), 81.0),
        (np.array([[8.1] * 4, [5.0] * 4]), 81.0),
    ],
)
def test_signs_that_differ_on_one_channel_add_their_forces(factors, force_ppm) -> None:
    assert 1e6 * guard_band(1e-6 * factors, LIMITS).force == pytest.approx(force_ppm)


def test_each_cause_has_its_share_of_the_step() -> None:
    guard = guard_band(np.full((3, 4), -8.1e-6), LIMITS)
    ppm = {cause: 1e6 * share for cause, share in guard._asdict().items()}
    assert ppm == pytest.approx(
        {
            "force": 81.0, "temperature": 6.0, "ageing": 2.0, "noise": 2 * math.sqrt(13.8), "pulling": 50.0,
            "placement": 30.0, "common": 20.0
        }
    )  # fmt: skip
    assert 1e6 * guard.step == pytest.approx(189.0 + 2 * math.sqrt(13.8))


@pytest.mark.parametrize(
    ("tick_s", "jitter_s", "stamps_per_s", "window_s", "millinewton"),
    [
        (1e-9, 0.3e-9, 1e7, 1e-3, 2.8), (1e-9, 0.3e-9, 1e7, 5e-3, 0.77),
        (1e-9, 0.3e-9, 1e7, 10e-3, 0.53), (1e-9, 0.3e-9, 1e7, 100e-3, 0.17),
        (1 / 170e6, 0.5e-9, 1e6, 1e-3, 31.0), (1 / 170e6, 0.5e-9, 1e6, 5e-3, 2.9),
        (1 / 170e6, 0.5e-9, 1e6, 10e-3, 1.1), (1 / 170e6, 0.5e-9, 1e6, 100e-3, 0.17),
    ],
)  # fmt: skip
def test_force_noise_is_that_of_known_counters(
    tick_s: float, jitter_s: float, stamps_per_s: float, window_s: float, millinewton: float
) -> None:
    # One channel, K = 6.3e-6 / N: figures of an independent study, given to two digits.
    counter_std = stamp_noise(tick_s, jitter_s, stamps_per_s, window_s)
    found = 1e3 * force_noise(-6.3e-6, counter_std, window_s, 1).total_newton
    assert found == pytest.approx(millinewton, rel=0.03)


def test_stamp_noise_is_that_of_a_regression_of_drawn_stamps() -> None:
    random = np.random.default_rng(3)
    stamps, window_s, tick_s, jitter_s = 500, 1e-3, 20e-9, 15e-9
    edges_s = (np.arange(stamps) + random.uniform(0, 1, (4000, 1))) * window_s / stamps
    read_s = np.floor((edges_s + random.normal(0, jitter_s, edges_s.shape)) / tick_s) * tick_s
    slopes = np.polyfit(np.arange(stamps), read_s.T, 1)[0] / (window_s / stamps)
    assert slopes.std() == pytest.approx(stamp_noise(tick_s, jitter_s, stamps / window_s, window_s), rel=0.05)


def test_four_channels_halve_the_counters_noise_and_not_the_oscillators() -> None:
    one, four = (force_noise(5e-6, 1e-9, 1e-2, channels) for channels in (1, 4))
    assert one.counter_newton == pytest.approx(2e-4)
    assert four.counter_newton == pytest.approx(1e-4)
    assert four.oscillator_newton == one.oscillator_newton > 0
    assert four.total_newton == pytest.approx(math.hypot(four.counter_newton, four.oscillator_newton))
