import math

import numpy as np
import pytest
from brute_force_board import Ladder
from drawn_touches import (
    COMMON_MODE_STD,
    COUNTER_STD,
    MODEL_ERROR,
    NOISE,
    OSCILLATOR_STD,
    draws,
    match_all,
    matcher_of,
    wrong,
)
from scipy.stats import multivariate_normal

from resonator_daemon.estimate.forces.force import hidden_fraction
from resonator_daemon.estimate.forces.site_identification import Matcher


@pytest.mark.parametrize("mixed_sign", [False, True])
@pytest.mark.parametrize("force", [-0.05, 0.0, 0.02, 1.0, 5.0, 10.0 * (1 - 1e-9)])
def test_eq_1_round_trip(force, mixed_sign):
    plate = Ladder(mixed_sign=mixed_sign)
    for site in range(16):
        match = matcher_of(plate).match(plate.loaded_hz(site, force), *NOISE)
        assert match.status == "ok"
        assert match.forces[0].site == site
        assert match.forces[0].force_newton == pytest.approx(force, abs=1e-8)


@pytest.mark.parametrize("lost", [(0,), (1, 3)])
@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0, np.inf])
def test_channels_that_are_not_known_are_left_out(lost, value):
    plate = Ladder()
    frequency = plate.loaded_hz(9, 2.0)
    frequency[list(lost)] = value
    match = matcher_of(plate).match(frequency, *NOISE)
    assert match.status == "ok"
    assert match.forces[0].site == 9
    assert match.forces[0].force_newton == pytest.approx(2.0, abs=1e-6)


def test_the_gate_of_fewer_channels_is_tighter():
    # Two channels have one degree of freedom: a chi2 of 14 passes with four, not with two.
    plate = Ladder(pull=0.0)
    difference = math.sqrt(14 * 2) * 1e-8
    two = plate.loaded_hz(0, 0.0) * (1 + np.array([difference, 0.0, np.nan, np.nan]))
    match = matcher_of(plate, model_error=0.0).match(two, np.full(4, 1e-8), OSCILLATOR_STD, COMMON_MODE_STD)
    assert match.chi2 == pytest.approx(14, rel=5e-3)
    assert match.status == "rejected"
    four = plate.loaded_hz(0, 0.0) * (1 + np.array([difference, 0.0, difference / 2, difference / 2]))
    match = matcher_of(plate, model_error=0.0).match(four, np.full(4, 1e-8), OSCILLATOR_STD, COMMON_MODE_STD)
    assert match.chi2 == pytest.approx(14, rel=5e-3)
    assert match.status == "ok"


@pytest.mark.parametrize("heard", [0, 1])
def test_one_channel_is_too_few(heard):
    plate = Ladder()
    frequency = np.where(np.arange(4) < heard, plate.loaded_hz(9, 2.0), np.nan)
    match = matcher_of(plate).match(frequency, *NOISE)
    assert match.status == "rejected"
    assert match.forces == ()
    assert f"{heard} channel" in match.reason.text


def test_codes_that_a_force_makes_alike_are_ambiguous():
    f0 = np.array([[10e6] * 4, [10e6 * (1 - 30e-6)] * 4])
    sensitivity = np.full((2, 4), -6.3e-6)
    match = Matcher(f0, sensitivity, 10.0).match(f0[0] / (1 + 6.3e-6 * 8.5), *NOISE)
    assert match.status == "ambiguous"
    assert match.forces == ()
    assert match.candidates == (0, 1)


def test_where_codes_overlap_the_odds_are_those_of_the_two_densities():
    f0 = np.array([[10e6, 10e6 * (1 + 2e-6), 10e6, 10e6], [10e6 * (1 - 25e-6)] * 4])
    sensitivity = np.array([[-6.3e-6] * 4, [-4e-6] * 4])
    matcher, rng, told = Matcher(f0, sensitivity, 10.0), np.random.default_rng(21), []
    for _ in range(400):
        site, force = int(rng.integers(2)), rng.uniform(0.0, 9.5)
        k = sensitivity[site] * (1 + MODEL_ERROR * rng.normal(size=4))
        frequency = f0[site] / (1 - k * force)
        match = matcher.match(frequency, *NOISE)
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


@pytest.mark.parametrize("pull", [0.0, 25e-6])
@pytest.mark.parametrize("force", [10.01, 12.0, 20.0, 30.0])
def test_a_force_beyond_the_range_is_an_overload_of_its_site(force, pull):
    plate = Ladder(pull=pull)
    match = matcher_of(plate).match(plate.loaded_hz(6, force), *NOISE)
    assert match.status == "overload"
    assert match.forces[0].site == 6
    assert match.forces[0].status == "overload"
    assert math.isnan(match.forces[0].force_newton)
    assert math.isnan(match.forces[0].noise_newton)
    assert math.isnan(match.forces[0].systematic_newton)
    assert match.forces[0].at_least_newton == 10.0


def test_a_touch_between_sites_is_reported_in_parts_or_covered_by_what_may_be_hidden():
    plate = Ladder()
    hidden = hidden_fraction(plate.positions_m, plate.outline_m, 4.0)
    matcher = matcher_of(plate, hidden_fraction=hidden)
    rng = np.random.default_rng(12)
    told = {1: 0, 2: 0}
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
            match = matcher.match(frequency, *NOISE)
            told[len(match.forces)] += 1
            assert match.status == "ok"
            assert {found.site for found in match.forces} == set(captured)
            for found in match.forces:
                assert found.force_newton == pytest.approx(share[found.site] * force, rel=1e-6)
                assert found.unobserved_bound_newton == pytest.approx(hidden[found.site] * found.force_newton)
                assert 0 <= force - found.force_newton <= found.unobserved_bound_newton * (1 + 1e-6)
    assert min(told.values()) > 10


@pytest.mark.parametrize(("oscillator", "common_mode"), [(math.nan, 1e-7), (1e-9, math.nan), (1e-9, math.inf)])
def test_a_common_error_of_unknown_size_is_refused(oscillator, common_mode):
    with pytest.raises(ValueError, match="common_mode_std"):
        matcher_of(Ladder()).match(Ladder().loaded_hz(1, 1.0), COUNTER_STD, oscillator, common_mode)


@pytest.mark.parametrize("shift", [5e-6, 10e-6, 20e-6, 60e-6])
def test_a_common_error_that_lifts_a_touch_above_its_band_is_not_an_overload_of_the_next_site(shift):
    # Channels alike: what lies above one site's untouched tone could be the site above it, under 50 N and more.
    plate = Ladder(pull=0.0)
    site, _, frequency = draws(plate, 1000, 71, newton=(0.05, 3.0))
    found = match_all(matcher_of(plate), frequency * (1 + shift))
    assert "overload" not in found.status
    assert (found.site[found.site >= 0] == site[found.site >= 0]).all()


@pytest.mark.parametrize("force_max_newton", [1.0, 3.0, 7.0, 10.0])
def test_the_largest_k_that_a_plate_may_have_gives_a_band_without_an_upper_end(force_max_newton):
    """At ten times the largest force, y = 1 - f0 / f = 1: f is beyond every limit. (In floats y may even exceed 1.)"""
    f0 = np.array([[10e6] * 4, [9e6] * 4])
    largest = 0.1 / force_max_newton
    matcher = Matcher(f0, np.array([[largest] * 4, [-largest] * 4]), force_max_newton)
    for share, status in ((0.5, "ok"), (1.2, "overload"), (9.0, "overload")):
        match = matcher.match(f0[0] / (1.0 - 0.1 * share), *NOISE)
        assert (match.status, [force.site for force in match.forces]) == (status, [0])
    within = matcher.match(f0[0] / (1.0 - 0.05), *NOISE)
    assert within.forces[0].force_newton == pytest.approx(0.5 * force_max_newton, rel=1e-6)


@pytest.mark.parametrize("mixed_sign", [False, True])
def test_statistics_of_the_matcher_on_a_400_ppm_ladder(mixed_sign):
    plate = Ladder(mixed_sign=mixed_sign)
    site, force, frequency = draws(plate, 20_000, seed=11)
    matches = match_all(matcher_of(plate), frequency)
    ok = matches.status == "ok"
    assert (ok | (matches.status == "rejected")).all()
    assert wrong(matches, site) == 0
    assert np.mean(~ok) == pytest.approx(1e-3, abs=6e-4)
    assert np.mean(matches.chi2) == pytest.approx(3.0, abs=0.08)
    # The bound by full matrices, of the true force.
    k = plate.sensitivity[site][ok]
    covariance = (COUNTER_STD**2 + (MODEL_ERROR * k * force[ok, None]) ** 2)[:, None, :] * np.eye(4)
    covariance += OSCILLATOR_STD**2 + COMMON_MODE_STD**2
    information = np.einsum("nc,nc->n", k, np.linalg.solve(covariance, k[..., None])[..., 0])
    standardised = (matches.force_newton - force)[ok] * np.sqrt(information)
    assert np.sqrt(np.mean(standardised**2)) <= 1.02
    assert abs(np.mean(standardised)) < 0.03
    # What is stated is neither much larger nor smaller than what is wrong.
    assert np.std((matches.force_newton - force)[ok] / matches.stated_newton[ok]) == pytest.approx(1.0, abs=0.03)
