import math

import numpy as np
import pytest

from resonator_daemon.estimate.forces.force_sites import ForceSites, SiteResponse, Warmth
from resonator_daemon.estimate.forces.site_errors import GAP_S, PressedSites, ResponseInverse, SiteErrors

K = 6.3e-6
HYSTERESIS_NEWTON = 0.1
RESPONSE = SiteResponse(HYSTERESIS_NEWTON, 0.0, 20.0, 0.0, 0.0, 0.0)
NONE = SiteResponse(0.0, 0.0, 20.0, 0.0, 0.0, 0.0)

FULL_SCALE_NEWTON = 10.0
NOISE_NEWTON = 5e-4
TOUCH_NEWTON = 0.02  # below it a site is silent
STEP_S = 1e-3


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


def press(errors, newton, time_s, *, noise=1e-3, systematic=0.0, touched=True):
    """Press site 1 of three."""
    numbers = (np.array([number]) for number in (newton, noise, systematic, 1 / K))
    pressed = errors.press(np.array([1]), *numbers, time_s, np.array([touched]))
    return PressedSites(*(part.item() for part in pressed))


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
    warm = errors(contact_std_kelvin=3.0, transient_s=transient_s, response=NONE)
    press(warm, 1.0, 100.0)
    pressed = press(warm, 1.0, 100.0 + held_s)
    assert pressed.unmodelled_newton == pytest.approx(expected_newton, rel=1e-3, abs=1e-9)
    assert pressed.systematic_newton == 0.0  # in which it would hide the touch that causes it


def test_a_slope_that_is_not_known_counts_where_the_known_one_is_none():
    for slope, expected in ((0.0, 1.0), (5e-8, math.sqrt(2))):
        warm = errors(slope=slope, slope_std=5e-8, contact_std_kelvin=3.0, response=NONE)
        press(warm, 1.0, 0.0)
        assert press(warm, 1.0, 1000.0).unmodelled_newton == pytest.approx(expected * 3.0 * 5e-8 / K)


@pytest.mark.parametrize("end", ["silence", "untouched", "reset"])
def test_the_warmth_of_a_touch_ends_with_it(end):
    warm = errors(contact_std_kelvin=3.0, response=NONE)
    press(warm, 1.0, 0.0)
    assert press(warm, 1.0, 10.0).unmodelled_newton > 0.1
    if end == "silence":
        warm.silence(10.1)
    elif end == "reset":
        warm.reset()
    else:
        press(warm, 0.0, 10.1, touched=False)
    assert press(warm, 1.0, 10.2).unmodelled_newton == 0.0
    assert press(warm, 1.0, 20.2).unmodelled_newton > 0.1


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
        force = press(calibrated, left_newton, 2.0 + 0.005 * number, noise=0.0, touched=False).force_newton
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


def feel(force_newton, h, c, tau_s):
    """What sites feel of forces (n, sites) at every millisecond: play by its three cases, creep by small steps."""
    play, creep = np.zeros(force_newton.shape[1]), np.zeros(force_newton.shape[1])
    felt = np.empty_like(force_newton)
    for index, force in enumerate(force_newton):
        play = np.where(force - play > h, force - h, np.where(play - force > h, force + h, play))
        creep = creep + STEP_S * (force - creep) / tau_s
        felt[index] = (force + play) / 2 * (1 - c) + c * creep
    return felt


def presses(sites, seconds, seed):
    """Random presses of 0.2 to 8 N: ramp, hold, half of them a part of the way back and a hold there, ramp."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(int(seconds / STEP_S)) * STEP_S
    force = np.zeros((len(time_s), sites))
    for site in range(sites):
        at_s = rng.uniform(0.5, 4)
        while True:
            knots = [(at_s, 0.0)]
            level = rng.uniform(0.2, 8)
            for newton in (level, level * rng.uniform(0.3, 1))[: rng.integers(1, 3)]:
                knots.append((knots[-1][0] + rng.uniform(0.05, 0.3), newton))
                knots.append((knots[-1][0] + rng.uniform(0.2, 6), newton))
            knots.append((knots[-1][0] + rng.uniform(0.05, 0.3), 0.0))
            if knots[-1][0] > seconds:
                break
            force[:, site] += np.interp(time_s, *np.transpose(knots))
            at_s = knots[-1][0] + rng.uniform(0.5, 8)
    return force


def follow(response, force, felt, *, noise=NOISE_NEWTON, every=5, seed=1):
    """Error, stated noise, stated systematic and time of each reading taken while a site is touched."""
    rng = np.random.default_rng(seed)
    sites = force.shape[1]
    inverse = ResponseInverse(sites, response, FULL_SCALE_NEWTON)
    inverse.release(np.arange(sites), 0.0)
    results, before = [], np.zeros(sites, dtype=bool)
    for index in range(0, len(force), every):
        touched = force[index] > TOUCH_NEWTON
        inverse.release(np.flatnonzero(before & ~touched), index * STEP_S)
        heard = np.flatnonzero(touched)
        reading = felt[index, heard] + noise * rng.normal(size=len(heard))
        pressing = inverse.press(heard, reading, np.full(len(heard), noise), index * STEP_S)
        results.append(
            [pressing.force_newton - force[index, heard], *pressing[1:], np.full(len(heard), index * STEP_S)]
        )
        before = touched
    return np.concatenate(results, axis=1)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def response_of(h, c, tau_s=20.0, *, off=0.0, std=0.0):
    return SiteResponse(h * (1 + off), c * (1 + off), tau_s * (1 + off), h * std, c * std, tau_s * std)


FORCE = presses(36, 40, seed=1)


@pytest.mark.parametrize(("h", "c", "untreated", "limit_newton"), [(0.0, 0.005, 0.014, 1e-3), (0.1, 0.0, 0.05, 2e-3)])
def test_creep_and_hysteresis_are_taken_out(h, c, untreated, limit_newton):
    felt = feel(FORCE, h, c, 20.0)
    assert rms((felt - FORCE)[FORCE > TOUCH_NEWTON]) == pytest.approx(untreated, abs=0.005)
    error, noise, systematic, _ = follow(response_of(h, c), FORCE, felt)
    assert rms(error) < limit_newton
    assert np.mean(np.abs(error) <= 2 * np.hypot(noise, systematic)) >= 0.93


@pytest.fixture(scope="module")
def felt_both():
    return feel(FORCE, 0.1, 0.005, 20.0)


@pytest.mark.parametrize("off", [-0.1, 0.1])
def test_parameters_10_per_cent_off_leave_less_than_10_millinewton_and_that_is_stated(off, felt_both):
    error, noise, systematic, time_s = follow(response_of(0.1, 0.005, off=off, std=0.1), FORCE, felt_both)
    assert 3e-3 < rms(error) < 1e-2
    total = np.hypot(noise, systematic)
    assert np.mean(np.abs(error) <= 2 * total) >= 0.93
    late = time_s > 20.0  # what pressed before the start is open until then
    assert rms(total[late]) < 2 * rms(error[late])


def test_noise_does_not_drag_the_play_along():
    # Held at 5 N for 40 s: the largest of 8 000 noisy readings would leave z, and so the force, 2 mN off.
    force = np.interp(np.arange(40_000) * STEP_S, [1.0, 1.2], [0.0, 5.0])[:, None] * np.ones(10)
    error, noise, _, _ = follow(response_of(0.1, 0.0), force, feel(force, 0.1, 0.0, 20.0))
    end = error.reshape(-1, 10)[-1000:]
    assert abs(end.mean()) < 4e-4
    assert end.std() < 1.1 * 2 * NOISE_NEWTON
    assert rms(noise[-2000:]) <= 2.001 * NOISE_NEWTON


def test_noise_is_that_of_the_reading_while_the_play_slides_and_twice_that_while_it_rests():
    inverse = ResponseInverse(1, response_of(0.1, 0.0), FULL_SCALE_NEWTON)
    site, noise = np.array([0]), np.array([1e-6])
    inverse.release(site, 0.0)
    up = [inverse.press(site, np.array([felt]), noise, 0.01 * k) for k, felt in enumerate((1.0, 2.0, 3.0))]
    assert up[-1].noise_newton == pytest.approx(1e-6)
    assert up[-1].force_newton == pytest.approx(3.05)  # F_e = F - h / 2
    back = inverse.press(site, np.array([2.99]), noise, 0.03)
    assert back.noise_newton == pytest.approx(2e-6)
    assert back.force_newton == pytest.approx(3.03, abs=1e-5)  # the play rests: half of what presses is felt


def test_what_a_site_was_before_is_uncertain_until_the_force_has_moved_by_2_h():
    inverse = ResponseInverse(2, response_of(0.1, 0.0), FULL_SCALE_NEWTON)
    sites = np.array([0, 1])
    inverse.release(sites, 0.0)
    # Site 0 was never pressed, z = 0; site 1 was, and z stayed at h.
    for k, force in enumerate((0.05, 0.1, 0.15)):
        play = np.maximum([0.0, 0.1], force - 0.1)
        light = inverse.press(sites, (force + play) / 2, np.full(2, 1e-9), 1.0 + 0.01 * k)
        assert (np.abs(light.force_newton - force) <= 1.01 * light.systematic_newton).all()
        assert (light.systematic_newton > 0.02).all()
    beyond = inverse.press(sites, np.array([0.201, 0.201]), np.full(2, 1e-9), 1.03)
    assert beyond.force_newton == pytest.approx(0.251, abs=1e-6)
    assert beyond.systematic_newton == pytest.approx(0.0, abs=1e-6)
    back = inverse.press(sites, np.array([0.2, 0.2]), np.full(2, 1e-9), 1.04)
    assert back.systematic_newton == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("play", [-0.1, -0.03, 0.06, 0.1])
def test_a_site_under_a_load_at_the_start_may_have_its_play_anywhere(play):
    inverse = ResponseInverse(1, response_of(0.1, 0.0), FULL_SCALE_NEWTON)
    result = inverse.press(np.array([0]), np.array([3.0 + play / 2]), np.array([1e-9]), 77.0)
    assert abs(result.force_newton[0] - 3.0) <= 1.01 * result.systematic_newton[0]
    assert result.systematic_newton == pytest.approx(0.05, rel=1e-6)


def test_after_a_gap_the_state_is_unknown_again_but_not_after_a_short_one():
    for gap_s, unknown in ((0.9 * GAP_S, False), (1.1 * GAP_S, True)):
        inverse = ResponseInverse(1, response_of(0.1, 0.0), FULL_SCALE_NEWTON)
        site, noise = np.array([0]), np.array([1e-9])
        inverse.release(site, 0.0)
        inverse.press(site, np.array([4.0]), noise, 1.0)
        result = inverse.press(site, np.array([3.99]), noise, 1.0 + gap_s)
        assert (result.systematic_newton[0] > 0.04) == unknown
        if not unknown:
            assert result.force_newton == pytest.approx(4.03, abs=1e-5)


def test_what_pressed_before_the_start_is_forgotten_with_the_creep_time():
    response, c = response_of(0.0, 0.005), 0.005
    for rest_s in (0.1, 20.0, 100.0):
        inverse = ResponseInverse(1, response, FULL_SCALE_NEWTON)
        site = np.array([0])
        inverse.release(site, 0.0)
        felt = (1 - c) * 1.0 + c * 8.0 * math.exp(-rest_s / 20)  # 8 N until just before
        result = inverse.press(site, np.array([felt]), np.array([1e-9]), rest_s)
        assert abs(result.force_newton[0] - 1.0) <= 2 * result.systematic_newton[0]
        assert result.systematic_newton == pytest.approx(c / (1 - c) * 5.0 * math.exp(-rest_s / 20), rel=1e-6)


def test_an_unknown_reading_is_an_unknown_force_and_a_known_one_beside_it_is_not():
    inverse = ResponseInverse(3, response_of(0.1, 0.005), FULL_SCALE_NEWTON)
    alone = ResponseInverse(3, response_of(0.1, 0.005), FULL_SCALE_NEWTON)
    result = inverse.press(np.array([2, 0]), np.array([math.nan, 1.5]), np.full(2, 1e-4), 5.0)
    other = alone.press(np.array([0]), np.array([1.5]), np.full(1, 1e-4), 5.0)
    assert np.isnan([column[0] for column in result]).all()
    assert [column[1] for column in result] == [column[0] for column in other]
