import math

import numpy as np
import pytest

from resonator_daemon.estimate.forces.force_sites import ForceSites, Warmth
from resonator_daemon.estimate.forces.site_errors import Pressed, SiteErrors
from resonator_daemon.estimate.forces.site_response import SiteResponse

K = 6.3e-6
HYSTERESIS_NEWTON = 0.1
RESPONSE = SiteResponse(HYSTERESIS_NEWTON, 0.0, 20.0, 0.0, 0.0, 0.0)


def errors(*, slope=-3e-7, slope_std=0.0, contact_std_kelvin=0.0, transient_s=0.0, **calibration):
    warmth = Warmth(
        np.tile([slope, -0.5e-9, 1.08e-10], (3, 1)), slope_std, transient_s, np.full(3, contact_std_kelvin), 5.0
    )
    return SiteErrors(
        ForceSites(
            np.full((3, 4), 1e7),
            np.full((3, 4), -K),
            np.zeros((3, 2)),
            np.zeros((4, 2)),
            10.0,
            warmth,
            0.015,
            **calibration,
        )
    )


def press(errors, newton, time_s, *, site=1, noise=1e-3, systematic=0.0):
    return errors.press(site, newton, noise, systematic, 1 / K, time_s)


def press_all(errors, newton, time_s, *, touched, noise=1e-3):
    """Press site 1 of three that are all heard."""
    felt, nothing = np.array([0.0, newton, 0.0]), np.zeros(3)
    pressed = errors.press_all(
        felt, np.full(3, noise), nothing, np.full(3, 1 / K), time_s, np.array([False, touched, False])
    )
    return Pressed(*(part[1].item() for part in pressed))


def test_without_a_response_and_warmth_a_force_is_what_the_site_feels():
    pressed = press(errors(), 2.0, 0.0, systematic=0.03)
    assert (pressed.force_newton, pressed.noise_newton, pressed.calibrated) == (2.0, 1e-3, True)
    assert pressed.systematic_newton == pytest.approx(0.03)


def test_a_response_that_was_not_calibrated_may_be_the_default_one():
    # A hysteresis of 1 % of the 10 N of this plate: half of it, and no more than presses; and half of 0.5 % of creep.
    for newton, unmodelled in ((0.02, 0.02), (2.0, 0.05), (8.0, math.hypot(0.05, 0.02))):
        assert press(errors(), newton, 0.0).unmodelled_newton == pytest.approx(unmodelled, rel=0.01)
        assert press(errors(response=RESPONSE), newton, 0.0).unmodelled_newton == 0.0


def test_the_shared_error_of_sensitivity_grows_with_the_force():
    shared = errors(sensitivity_std=0.01)
    assert press(shared, 4.0, 0.0, systematic=0.03).systematic_newton == pytest.approx(0.05)
    assert press(shared, 0.0, 0.1, systematic=0.03).systematic_newton == pytest.approx(0.03)


@pytest.mark.parametrize("transient_s", [0.0, -2e-7])
@pytest.mark.parametrize("held_s", [0.0, 0.5, 5.0, 30.0])
def test_a_warm_touch_moves_the_force_by_what_a_warming_site_would(held_s, transient_s):
    # The site's temperature by small steps of its own equation, for a contact one standard deviation warmer.
    step_s, warm_kelvin, rate = 1e-4, 0.0, 3.0 / 5.0
    for _ in range(round(held_s / step_s)):
        rate = (3.0 - warm_kelvin) / 5.0
        warm_kelvin += rate * step_s
    rate = (3.0 - warm_kelvin) / 5.0
    expected_newton = abs(-3e-7 * warm_kelvin + transient_s * rate) / K
    warm = errors(contact_std_kelvin=3.0, transient_s=transient_s)
    press(warm, 1.0, 100.0)
    assert press(warm, 1.0, 100.0 + held_s).systematic_newton == pytest.approx(expected_newton, rel=1e-3, abs=1e-9)


def test_a_slope_that_is_not_known_counts_where_the_known_one_is_none():
    warm = errors(slope=0.0, slope_std=5e-8, contact_std_kelvin=3.0)
    press(warm, 1.0, 0.0)
    assert press(warm, 1.0, 1000.0).systematic_newton == pytest.approx(3.0 * 5e-8 / K)
    both = errors(slope=5e-8, slope_std=5e-8, contact_std_kelvin=3.0)
    press(both, 1.0, 0.0)
    assert press(both, 1.0, 1000.0).systematic_newton == pytest.approx(math.sqrt(2) * 3.0 * 5e-8 / K)


@pytest.mark.parametrize("end", ["silence", "untouched", "reset"])
def test_the_warmth_of_a_touch_ends_with_it(end):
    warm = errors(contact_std_kelvin=3.0)
    press(warm, 1.0, 0.0)
    assert press(warm, 1.0, 10.0).systematic_newton > 0.1
    if end == "silence":
        warm.silence(10.1)
    elif end == "reset":
        warm.reset()
    else:
        press_all(warm, 0.0, 10.1, touched=False)
    assert press(warm, 1.0, 10.2).systematic_newton == 0.0
    assert press(warm, 1.0, 20.2).systematic_newton > 0.1


def test_the_warmth_of_a_touch_must_not_hide_it_where_sites_are_heard_untouched():
    warm = errors(contact_std_kelvin=3.0)
    press_all(warm, 1.0, 0.0, touched=True)
    pressed = press_all(warm, 1.0, 10.0, touched=True)
    alone = errors(contact_std_kelvin=3.0)
    press(alone, 1.0, 0.0)
    warmth_newton = press(alone, 1.0, 10.0).systematic_newton
    assert warmth_newton > 0.1
    assert pressed.systematic_newton == 0.0
    assert pressed.unmodelled_newton == pytest.approx(
        math.hypot(press(errors(), 1.0, 0.0).unmodelled_newton, warmth_newton)
    )


@pytest.mark.parametrize(
    ("newton", "calibrated"), [(0.49, False), (0.51, True), (8.0, True), (8.1, True), (8.2, False), (-1.0, False)]
)
def test_forces_beyond_those_of_calibration_are_not_calibrated(newton, calibrated):
    ranged = errors(valid_newton=(0.66, 8.0))  # 2 % of the largest is let pass on either side
    assert press(ranged, newton, 0.0).calibrated is calibrated


def followed(errors, forces):
    """Forces that come back where a play of 0.1 N lies between what presses and what is felt, written out here."""
    z, given = 0.0, []
    for number, newton in enumerate(forces):
        z = min(max(z, newton - HYSTERESIS_NEWTON), newton + HYSTERESIS_NEWTON)
        given.append(press(errors, (newton + z) / 2, 0.005 * number, noise=0.0).force_newton)
    return np.array(given)


CYCLE = np.concatenate(
    [np.linspace(0, 5, 200), np.linspace(5, 1, 200), np.linspace(1, 4, 200), np.linspace(4, 0.2, 200)]
)


def test_hysteresis_is_taken_out_where_it_was_calibrated():
    calibrated = errors(response=RESPONSE)
    calibrated.silence(-1.0)
    # What was before the start is not known to less than h; from the first turn on everything is.
    assert np.abs(followed(calibrated, CYCLE) - CYCLE)[210:].max() < 1e-9
    assert np.abs(followed(errors(), CYCLE) - CYCLE)[210:].max() == pytest.approx(HYSTERESIS_NEWTON / 2, rel=1e-6)


def test_what_a_press_leaves_in_a_site_is_no_force():
    calibrated = errors(response=RESPONSE)
    calibrated.silence(-1.0)
    followed(calibrated, np.concatenate([np.linspace(0, 5, 200), np.linspace(5, 0, 200)]))
    left_newton = HYSTERESIS_NEWTON / 2  # z stays h above 0: (0 + h) / 2 is felt
    for number in range(20):
        force = press_all(calibrated, left_newton, 2.0 + 0.005 * number, noise=0.0, touched=False).force_newton
        assert force == pytest.approx(0.0, abs=1e-9)


def test_an_error_of_the_response_is_a_systematic_one():
    doubtful = SiteResponse(HYSTERESIS_NEWTON, 0.0, 20.0, 0.3 * HYSTERESIS_NEWTON, 0.0, 0.0)
    sure, unsure = errors(response=RESPONSE), errors(response=doubtful)
    for each in (sure, unsure):
        each.silence(-1.0)
        followed(each, CYCLE[:250])
    last = CYCLE[249] + HYSTERESIS_NEWTON / 2  # unloading: z above what presses
    assert press(sure, last, 1.25, noise=0.0).systematic_newton == pytest.approx(0.0, abs=1e-6)
    assert press(unsure, last, 1.25, noise=0.0).systematic_newton == pytest.approx(
        0.3 * HYSTERESIS_NEWTON / 2, rel=0.05
    )


@pytest.mark.parametrize("response", [None, RESPONSE])
def test_all_sites_are_pressed_as_one_is(response):
    together, alone = (
        errors(contact_std_kelvin=3.0, slope_std=5e-8, transient_s=-2e-7, sensitivity_std=0.01, response=response)
        for _ in range(2)
    )
    for each in (together, alone):
        each.rest(0.0)
    draw = np.random.default_rng(1)
    newtons = [0.15, 0.3, 2.0, 0.15, math.nan, *draw.uniform(-0.5, 12.0, 100)]
    times_s = np.cumsum([0.005, 0.01, 0.01, 0.01, 0.01, *draw.uniform(0.001, 1.0, 100)]).tolist()
    for newton, time_s in zip(newtons, times_s, strict=True):
        of_all = press_all(together, newton, time_s, touched=True)
        of_one = press(alone, newton, time_s)
        # Of sites that are heard untouched, warmth counts as untold; the whole is the same.
        assert of_all.calibrated == of_one.calibrated
        assert of_all[:2] == pytest.approx(of_one[:2], rel=1e-12, nan_ok=True)
        whole = [math.hypot(each.systematic_newton, each.unmodelled_newton) for each in (of_all, of_one)]
        assert whole[0] == pytest.approx(whole[1], rel=1e-12, nan_ok=True)
