import math

import numpy as np
import pytest
from brute_force_board import Ladder
from scipy.stats import multivariate_normal

from resonator_daemon.measurement.counting import oscillator_std
from resonator_daemon.measurement.force import hidden_fraction
from resonator_daemon.measurement.matching import Match, Matcher, OverloadLatch, SiteForce

COUNTER_STD = np.full(4, 5e-10)
OSCILLATOR_STD = oscillator_std(0.01)
COMMON_MODE_STD = 2e-7
MODEL_ERROR = 0.015


def matcher_of(plate, **options):
    return Matcher(plate.f0_hz, plate.sensitivity, plate.force_max_newton, **options)


def draws(plate, count, seed, *, model_error=MODEL_ERROR, counter_std=COUNTER_STD):
    """True site, force and counted frequencies, with every error the model names drawn at its stated size."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        site, force = int(rng.integers(16)), rng.uniform(0.1, 9.0)
        sensitivity = plate.sensitivity[site] * (1 + model_error * rng.normal(size=4))
        error = counter_std * rng.normal(size=4) + OSCILLATOR_STD * rng.normal() + COMMON_MODE_STD * rng.normal()
        # y = 1 - f0 / f, so f = f0 / (1 - y)
        yield site, force, plate.f0_hz[site] / (1 - sensitivity * force - error)


@pytest.mark.parametrize("mixed_sign", [False, True])
def test_statistics_of_the_matcher_on_a_400_ppm_ladder(mixed_sign):
    plate = Ladder(mixed_sign=mixed_sign)
    matcher = matcher_of(plate)
    wrong = rejected = 0
    chi2, standardised = [], []
    for site, force, frequency in draws(plate, 20_000, seed=11):
        match = matcher.match(frequency, COUNTER_STD, OSCILLATOR_STD)
        assert match.status in ("ok", "rejected")
        chi2.append(match.chi2)
        if match.force is None:
            rejected += 1
            continue
        wrong += match.force.site != site
        k = plate.sensitivity[site]
        covariance = np.diag(COUNTER_STD**2 + (MODEL_ERROR * k * force) ** 2)
        covariance += OSCILLATOR_STD**2 + COMMON_MODE_STD**2
        bound = 1 / np.sqrt(k @ np.linalg.solve(covariance, k))
        standardised.append((match.force.force_newton - force) / bound)
    assert wrong == 0
    assert 4e-4 <= rejected / 20_000 <= 1.7e-3
    assert np.mean(chi2) == pytest.approx(3.0, abs=0.06)
    assert np.std(standardised) == pytest.approx(1.0, abs=0.02)
    assert abs(np.mean(standardised)) < 0.03


def test_chi2_and_force_are_those_of_the_full_matrices():
    plate = Ladder(2, mixed_sign=True)
    matcher = matcher_of(plate)
    std = np.array([1e-8, 3e-8, 2e-8, 5e-9])
    for site, force, frequency in draws(plate, 20, seed=3, counter_std=std):
        match = matcher.match(frequency, std, 1e-8)
        y, k = 1 - plate.f0_hz[site] / frequency, plate.sensitivity[site]
        covariance = np.diag(std**2) + 1e-16 + COMMON_MODE_STD**2
        estimate = k @ np.linalg.solve(covariance, y) / (k @ np.linalg.solve(covariance, k))
        covariance += np.diag((MODEL_ERROR * k * estimate) ** 2)
        inverse = np.linalg.inv(covariance)
        estimate = k @ inverse @ y / (k @ inverse @ k)
        residual = y - k * estimate
        assert match.force.force_newton == pytest.approx(estimate, rel=1e-9)
        assert match.force.force_newton == pytest.approx(force, rel=0.1)
        assert match.chi2 == pytest.approx(residual @ inverse @ residual, rel=1e-5)


@pytest.mark.parametrize("mixed_sign", [False, True])
@pytest.mark.parametrize("force", [-0.05, 0.0, 0.02, 1.0, 5.0, 10.0 * (1 - 1e-9)])
def test_eq_1_round_trip(force, mixed_sign):
    plate = Ladder(mixed_sign=mixed_sign)
    for site in range(16):
        match = matcher_of(plate).match(plate.loaded_hz(site, force), COUNTER_STD, OSCILLATOR_STD)
        assert match.status == "ok"
        assert match.force.site == site
        assert match.force.force_newton == pytest.approx(force, abs=1e-8)


def test_noise_is_the_spread_of_forces_and_systematic_the_stated_parts():
    plate = Ladder()
    matcher, counter = matcher_of(plate), np.array([4e-9, 8e-9, 4e-9, 6e-9])
    rng = np.random.default_rng(4)
    forces = []
    for _ in range(3000):
        error = counter * rng.normal(size=4) + OSCILLATOR_STD * rng.normal()
        match = matcher.match(plate.loaded_hz(5, 0.5) * (1 + error), counter, OSCILLATOR_STD)
        forces.append(match.force)
    assert np.std([f.force_newton for f in forces]) == pytest.approx(forces[0].noise_newton, rel=0.04)
    expected = math.hypot(0.015 * 0.5, COMMON_MODE_STD / abs(plate.sensitivity[5, 0]))
    assert forces[0].systematic_newton == pytest.approx(expected, rel=0.01)


def test_a_common_mode_leaves_mixed_sign_channels_almost_alone():
    plate = Ladder(mixed_sign=True)
    match = matcher_of(plate).match(plate.loaded_hz(3, 1.0) * (1 + 3e-7), COUNTER_STD, OSCILLATOR_STD)
    assert match.status == "ok"
    assert match.force.force_newton == pytest.approx(1.0, abs=1e-3)
    assert match.force.systematic_newton == pytest.approx(0.015, rel=0.05)


def test_noise_alone_in_the_gate_would_reject_true_touches():
    # What the model error is for: sensitivities 1.5 % off pass, 15 % off do not.
    plate = Ladder(3)
    outcomes = {
        error: [
            matcher_of(plate).match(frequency, COUNTER_STD, OSCILLATOR_STD).status == "ok"
            for _, force, frequency in draws(plate, 200, seed=5, model_error=error)
            if force > 1
        ]
        for error in (0.015, 0.15)
    }
    assert np.mean(outcomes[0.015]) > 0.98
    assert np.mean(outcomes[0.15]) < 0.2


@pytest.mark.parametrize("lost", [(0,), (1, 3)])
@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0, np.inf])
def test_channels_that_are_not_known_are_left_out(lost, value):
    plate = Ladder()
    frequency = plate.loaded_hz(9, 2.0)
    frequency[list(lost)] = value
    match = matcher_of(plate).match(frequency, COUNTER_STD, OSCILLATOR_STD)
    assert match.status == "ok"
    assert match.force.site == 9
    assert match.force.force_newton == pytest.approx(2.0, abs=1e-6)


def test_the_gate_of_fewer_channels_is_tighter():
    # Two channels have one degree of freedom: a chi2 of 14 passes with four, not with two.
    plate = Ladder(pull=0.0)
    difference = math.sqrt(14 * 2) * 1e-8
    two = plate.loaded_hz(0, 0.0) * (1 + np.array([difference, 0.0, np.nan, np.nan]))
    match = matcher_of(plate).match(two, np.full(4, 1e-8), OSCILLATOR_STD)
    assert match.chi2 == pytest.approx(14, rel=5e-3)
    assert match.status == "rejected"
    four = plate.loaded_hz(0, 0.0) * (1 + np.array([difference, 0.0, difference / 2, difference / 2]))
    match = matcher_of(plate).match(four, np.full(4, 1e-8), OSCILLATOR_STD)
    assert match.chi2 == pytest.approx(14, rel=5e-3)
    assert match.status == "ok"


@pytest.mark.parametrize("heard", [0, 1])
def test_one_channel_is_too_few(heard):
    plate = Ladder()
    frequency = np.where(np.arange(4) < heard, plate.loaded_hz(9, 2.0), np.nan)
    match = matcher_of(plate).match(frequency, COUNTER_STD, OSCILLATOR_STD)
    assert match.status == "rejected"
    assert match.force is None
    assert f"{heard} channel" in match.reason


def test_codes_that_a_force_makes_alike_are_ambiguous():
    f0 = np.array([[10e6] * 4, [10e6 * (1 - 30e-6)] * 4])
    sensitivity = np.full((2, 4), -6.3e-6)
    match = Matcher(f0, sensitivity, 10.0).match(f0[0] / (1 + 6.3e-6 * 8.5), COUNTER_STD, OSCILLATOR_STD)
    assert match.status == "ambiguous"
    assert match.force is None
    assert "0" in match.reason
    assert "1" in match.reason


def test_where_codes_overlap_the_odds_are_those_of_the_two_densities():
    f0 = np.array([[10e6, 10e6 * (1 + 2e-6), 10e6, 10e6], [10e6 * (1 - 25e-6)] * 4])
    sensitivity = np.array([[-6.3e-6] * 4, [-4e-6] * 4])
    matcher, rng, told = Matcher(f0, sensitivity, 10.0), np.random.default_rng(21), []
    for _ in range(400):
        site, force = int(rng.integers(2)), rng.uniform(0.0, 9.5)
        k = sensitivity[site] * (1 + MODEL_ERROR * rng.normal(size=4))
        frequency = f0[site] / (1 - k * force)
        match = matcher.match(frequency, COUNTER_STD, OSCILLATOR_STD)
        log_density = []
        for m in range(2):
            y = 1 - f0[m] / frequency
            covariance = np.diag(COUNTER_STD**2) + OSCILLATOR_STD**2 + COMMON_MODE_STD**2
            for _ in range(2):  # first without, then with the model error at the force found
                inverse = np.linalg.inv(covariance)
                found = sensitivity[m] @ inverse @ y / (sensitivity[m] @ inverse @ sensitivity[m])
                last, covariance = covariance, covariance + np.diag((MODEL_ERROR * sensitivity[m] * found) ** 2)
            if -0.2 <= found <= 10.0:
                log_density.append(multivariate_normal(sensitivity[m] * found, last).logpdf(y))
        if match.status == "rejected" or len(log_density) < 2:
            continue
        told.append(match.status)
        assert (match.status == "ok") == (abs(log_density[0] - log_density[1]) >= 13.8 / 2)
    assert min(told.count("ok"), told.count("ambiguous")) > 20


def test_channels_that_hear_different_sites_are_ambiguous():
    plate = Ladder()
    frequency = np.where([True, True, False, True], plate.loaded_hz(2, 1.0), plate.loaded_hz(7, 3.0))
    match = matcher_of(plate).match(frequency, COUNTER_STD, OSCILLATOR_STD)
    assert match.status == "ambiguous"
    assert match.force is None


def test_a_tone_that_is_no_sites_is_rejected():
    plate = Ladder()
    match = matcher_of(plate).match(np.full(4, 10.02e6), COUNTER_STD, OSCILLATOR_STD)
    assert match.status == "rejected"
    assert match.force is None


def test_a_chance_excess_of_the_gate_is_not_an_overload_of_the_neighbour():
    # Corners alike: the tone of every site is also that of its neighbour under some force beyond the range.
    plate = Ladder(pull=0.0)
    off = plate.loaded_hz(4, 5.0) * (1 + 4e-6 * np.array([1, -1, 1, -1]))
    assert matcher_of(plate).match(off, COUNTER_STD, OSCILLATOR_STD).status == "rejected"


@pytest.mark.parametrize("pull", [0.0, 25e-6])
@pytest.mark.parametrize("force", [10.01, 12.0, 20.0, 30.0])
def test_a_force_beyond_the_range_is_an_overload_of_its_site(force, pull):
    plate = Ladder(pull=pull)
    match = matcher_of(plate).match(plate.loaded_hz(6, force), COUNTER_STD, OSCILLATOR_STD)
    assert match.status == "overload"
    assert match.force.site == 6
    assert match.force.status == "overload"
    assert math.isnan(match.force.force_newton)
    assert math.isnan(match.force.noise_newton)
    assert math.isnan(match.force.systematic_newton)
    assert match.force.at_least_newton == 10.0


@pytest.mark.parametrize("pull", [0.0, 25e-6])
def test_no_force_of_a_ramp_to_80_newton_looks_plausible_while_latched(pull):
    plate = Ladder(pull=pull)
    matcher = matcher_of(plate)
    for site in range(16):
        latch = OverloadLatch()
        unlatched_plausible = 0
        for force in np.arange(0.1, 80.0, 0.1):
            raw = matcher.match(plate.loaded_hz(site, force), COUNTER_STD, OSCILLATOR_STD)
            match = latch.apply(raw)
            if force <= 9.95:
                assert match.status == "ok"
                assert match.force.force_newton == pytest.approx(force, abs=1e-3)
            elif force >= 10.05:
                unlatched_plausible += raw.status == "ok"
                assert match.status == "overload"
                assert match.force.site == site
                assert math.isnan(match.force.force_newton)
        # Without a latch the ramp crosses the codes of the sites below, where there are any.
        if pull == 0 and plate.code[site] < 16 and abs(plate.sensitivity[site, 0]) > 5.2e-6:
            assert unlatched_plausible > 0


def outcome(status, site):
    newton = 1.0 if status == "ok" else math.nan
    return Match(status, "", 3.0, None if site is None else SiteForce(site, newton, 0.1, 0.1, status))


def test_the_latch_lets_go_for_the_same_site_in_range_or_the_pilot():
    latch = OverloadLatch()
    held = outcome("overload", 3)
    assert latch.apply(outcome("ok", 5)) == outcome("ok", 5)
    assert latch.apply(held) is held
    for other in (outcome("ok", 4), outcome("overload", 4), outcome("rejected", None), outcome("ambiguous", None)):
        assert latch.apply(other) is held
    assert latch.apply(outcome("ok", 3)) == outcome("ok", 3)
    assert latch.apply(outcome("ok", 4)) == outcome("ok", 4)
    latch.apply(held)
    latch.release()
    assert latch.apply(outcome("ok", 4)) == outcome("ok", 4)


def test_a_touch_between_sites_is_ambiguous_or_covered_by_the_systematic():
    plate = Ladder()
    hidden = hidden_fraction(plate.positions_m, plate.outline_m, 4.0)
    matcher = matcher_of(plate, hidden_fraction=hidden)
    rng = np.random.default_rng(12)
    told = {"ok": 0, "ambiguous": 0}
    pairs = [
        (i, j) for i in range(16) for j in range(i) if np.hypot(*(plate.positions_m[i] - plate.positions_m[j])) < 6e-3
    ]
    for i, j in pairs:
        for _ in range(4):
            touch = plate.positions_m[i] + rng.uniform(0.35, 0.65) * (plate.positions_m[j] - plate.positions_m[i])
            force = rng.uniform(0.5, 6.0)
            raw = ((plate.positions_m - touch) ** 2).sum(axis=1) ** -2.0
            share = raw / raw.sum()
            # Each corner captures the site with the largest share as it hears it: levels differ by a factor below 2.
            captured = [int(np.argmax(share * rng.uniform(0.75, 1.33, 16))) for _ in range(4)]
            frequency = np.array([plate.loaded_hz(m, share[m] * force)[c] for c, m in enumerate(captured)])
            match = matcher.match(frequency, COUNTER_STD, OSCILLATOR_STD)
            told[match.status] += 1
            assert (match.status == "ambiguous") == (len(set(captured)) > 1)
            if match.force:
                assert match.force.site == captured[0]
                assert abs(match.force.force_newton - force) <= match.force.systematic_newton
    assert min(told.values()) > 10


GOOD_F0 = np.full((2, 4), 10e6)
GOOD_K = np.full((2, 4), -6.3e-6)


@pytest.mark.parametrize(
    ("f0", "sensitivity", "largest", "message"),
    [
        (GOOD_F0, GOOD_K[:1], 10.0, "one shape"),
        (GOOD_F0[0], GOOD_K[0], 10.0, "one shape"),
        (GOOD_F0 * np.nan, GOOD_K, 10.0, "f0_hz"),
        (-GOOD_F0, GOOD_K, 10.0, "f0_hz"),
        (GOOD_F0, GOOD_K * np.array([1, 1, 0, 1]), 10.0, "sensitivity"),
        (GOOD_F0, GOOD_K * np.inf, 10.0, "sensitivity"),
        (GOOD_F0, GOOD_K, 0.0, "force_max_newton"),
        (GOOD_F0, GOOD_K, math.nan, "force_max_newton"),
    ],
)
def test_impossible_plates_are_refused(f0, sensitivity, largest, message):
    with pytest.raises(ValueError, match=message):
        Matcher(f0, sensitivity, largest)
