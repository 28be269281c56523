import math
from typing import NamedTuple

import numpy as np
import pytest
from brute_force_board import Ladder
from scipy.stats import multivariate_normal

from resonator_daemon.base.plate import load_plate
from resonator_daemon.estimate.forces.force_sites import hidden_fraction
from resonator_daemon.estimate.forces.site_identification import Match, Matcher, OverloadLatch, SiteForce
from resonator_daemon.estimate.tones.frequency_estimators import oscillator_std

COUNTER_STD = np.full(4, 5e-10)
OSCILLATOR_STD = oscillator_std(0.01)
COMMON_MODE_STD = 2e-7
MODEL_ERROR = 0.015
NOISE = (COUNTER_STD, OSCILLATOR_STD, COMMON_MODE_STD)


def matcher_of(plate, **options):
    return Matcher(plate.f0_hz, plate.sensitivity, plate.force_max_newton, **options)


def draws(plate, count, seed, *, newton=(0.1, 9.0), model_error=MODEL_ERROR, noise=NOISE):
    """True sites (n,), forces (n,), frequencies (n, 4), with every error the model names drawn at its stated size."""
    rng = np.random.default_rng(seed)
    site, force = rng.integers(len(plate.f0_hz), size=count), rng.uniform(*newton, count)
    sensitivity = plate.sensitivity[site] * (1 + model_error * rng.normal(size=(count, 4)))
    counter_std, oscillator, common_mode = noise
    error = counter_std * rng.normal(size=(count, 4))
    error += oscillator * rng.normal(size=(count, 1)) + common_mode * rng.normal(size=(count, 1))
    # y = 1 - f0 / f, so f = f0 / (1 - y)
    return site, force, plate.f0_hz[site] / (1 - sensitivity * force[:, None] - error)


class Outcomes(NamedTuple):
    """Outcomes of n readings, arrays (n,); `site` is -1 and the others are NaN where not one site is named."""

    matches: list
    status: np.ndarray
    site: np.ndarray
    force_newton: np.ndarray
    stated_newton: np.ndarray
    chi2: np.ndarray


def match_all(matcher, frequency, noise=NOISE):
    """Match readings (n, channels), with noise that is the same for all."""
    matches = [matcher.match(row, *noise) for row in frequency.tolist()]
    named = [match.forces[0] if len(match.forces) == 1 else None for match in matches]
    numbers = [
        (f.site, f.force_newton, np.hypot(f.noise_newton, f.systematic_newton)) if f else (-1, np.nan, np.nan)
        for f in named
    ]
    site, force, stated = np.array(numbers).T
    status, chi2 = (np.array([getattr(match, name) for match in matches]) for name in ("status", "chi2"))
    return Outcomes(matches, status, site.astype(int), force, stated, chi2)


def wrong(outcomes, site):
    """How many of the readings name a site that is not the true one."""
    named = zip(outcomes.matches, site.tolist(), strict=True)
    return sum(any(force.site != true for force in match.forces) for match, true in named)


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
    for others, status in ((np.nan, "rejected"), (difference / 2, "ok")):
        frequency = plate.loaded_hz(0, 0.0) * (1 + np.array([difference, 0.0, others, others]))
        match = matcher_of(plate, model_error=0.0).match(frequency, np.full(4, 1e-8), OSCILLATOR_STD, COMMON_MODE_STD)
        assert match.chi2 == pytest.approx(14, rel=5e-3)
        assert match.status == status


@pytest.mark.parametrize("heard", [0, 1])
def test_one_channel_is_too_few(heard):
    plate = Ladder()
    frequency = np.where(np.arange(4) < heard, plate.loaded_hz(9, 2.0), np.nan)
    match = matcher_of(plate).match(frequency, *NOISE)
    assert match.status == "rejected"
    assert match.forces == ()
    assert f"{heard} channel" in match.reason.text


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


def outcome(**statuses):
    """Match of sites named like s3, each "ok" or "overload"."""
    forces = [
        SiteForce(int(site[1:]), 1.0 if status == "ok" else math.nan, 0.1, 0.1, status)
        for site, status in statuses.items()
    ]
    status = "rejected" if not forces else "overload" if "overload" in statuses.values() else "ok"
    return Match(status, "", 3.0, tuple(forces))


def test_the_latch_holds_no_force_of_another_site():
    latch = OverloadLatch()  # compared by their text, in which NaN is NaN
    both = outcome(s2="ok", s3="overload")
    assert repr(latch.apply(both)) == repr(both)
    assert repr(latch.apply(outcome(s4="ok"))) == repr(outcome(s3="overload"))
    # The overloaded site is received again with another one: both are of this reading.
    fresh = outcome(s3="overload", s6="ok")
    assert repr(latch.apply(fresh)) == repr(fresh)
    assert repr(latch.apply(outcome())) == repr(outcome(s3="overload"))
    assert repr(latch.apply(outcome(s3="ok", s6="ok"))) == repr(outcome(s3="ok", s6="ok"))
    assert repr(latch.apply(outcome())) == repr(outcome())
    latch.apply(outcome(s3="overload"))
    latch.release()
    assert latch.apply(outcome(s4="ok")) == outcome(s4="ok")


def test_of_two_sites_in_overload_the_one_that_stays_so_is_held():
    latch = OverloadLatch()
    latch.apply(outcome(s3="overload", s4="overload"))
    assert repr(latch.apply(outcome(s3="ok"))) == repr(outcome(s3="overload", s4="overload"))
    latch.apply(outcome(s3="ok", s4="overload"))
    assert repr(latch.apply(outcome(s9="ok"))) == repr(outcome(s4="overload"))


class Shipped(Ladder):
    def __init__(self):
        super().__init__()
        tones = load_plate("quartz16").tones
        self.f0_hz, self.sensitivity = tones.f0_hz, tones.sensitivity


PLATES = {"ladder": Ladder(), "mixed signs": Ladder(mixed_sign=True), "quartz16": Shipped()}


def two_touches(plate, captured, seed):
    """Two touches of each reading, sites and forces (n, 2), and what channels hear: the second one if `captured`."""
    rng = np.random.default_rng(seed)
    site = rng.permuted(np.tile(np.arange(16), (len(captured), 1)), axis=1)[:, :2]
    force, heard = rng.uniform(0.2, 8.0, site.shape), captured.astype(int)
    tone = np.take_along_axis(site, heard, axis=1), np.arange(4)
    k = plate.sensitivity[tone] * (1 + MODEL_ERROR * rng.normal(size=heard.shape))
    counter_std, *common = NOISE
    error = counter_std * rng.normal(size=heard.shape)
    error += np.hypot(*common) * rng.normal(size=(len(heard), 1))
    return site, force, plate.f0_hz[tone] / (1 - k * np.take_along_axis(force, heard, axis=1) - error)


def channels_of_the_second(count, seed):
    rng = np.random.default_rng(seed)
    order = rng.permuted(np.tile(np.arange(4), (count, 1)), axis=1)
    return order < rng.integers(1, 4, (count, 1))


@pytest.mark.parametrize("name", PLATES)
def test_two_touches_are_both_found_and_none_is_wrong(name):
    plate, count = PLATES[name], 800
    captured = channels_of_the_second(count, 31)
    site, force, frequency = two_touches(plate, captured, 32)
    matches = match_all(matcher_of(plate), frequency)
    # With mixed signs, sites above and below a third one may look like that one under 60 N.
    ambiguous = np.mean(matches.status == "ambiguous")
    assert ambiguous <= (0.01 if name == "mixed signs" else 0.0)
    assert (matches.site == -1).all()
    errors = []
    for row, match in enumerate(matches.matches):
        for found in match.forces:
            touch = int(site[row, 1] == found.site)
            assert found.site == site[row, touch]
            assert found.channels == tuple(np.flatnonzero(captured[row] == touch))
            stated = math.hypot(found.noise_newton, found.systematic_newton)
            errors.append((found.force_newton - force[row, touch]) / stated)
    assert len(errors) >= 2 * 0.99 * count
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.05)


def test_one_channel_with_a_foreign_tone_is_left_out():
    plate, count = Ladder(), 800
    site, force, frequency = draws(plate, count, 51)
    rng = np.random.default_rng(52)
    odd = rng.integers(4, size=count)
    # Between the bands: above every untouched tone by 100 ppm, where no negative K reaches.
    foreign = 10e6 * (1 - 400e-6 * rng.integers(1, 17, count)) * (1 + rng.uniform(100e-6, 200e-6, count))
    frequency[np.arange(count), odd] = foreign
    matches = match_all(matcher_of(plate), frequency)
    found = matches.status == "ok"
    assert np.mean(found) >= 0.99
    assert np.array_equal(matches.site[found], site[found])
    assert np.max(np.abs(matches.force_newton - force)[found]) < 0.5
    for row in np.flatnonzero(found):
        (only,) = matches.matches[row].forces
        assert only.channels == tuple(c for c in range(4) if c != odd[row])
        assert f"channel {odd[row]} " in matches.matches[row].reason.text


def test_channels_that_each_hear_another_site_are_told_apart_down_to_two():
    plate = Ladder()
    frequency = np.array([plate.loaded_hz(3 * c + 1, 1.0 + c)[c] for c in range(4)])
    for count in (4, 3, 2):
        heard = np.where(np.arange(4) < count, frequency, np.nan)
        match = matcher_of(plate).match(heard, *NOISE)
        assert match.status == "ok"
        assert [(force.site, force.channels) for force in match.forces] == [(3 * c + 1, (c,)) for c in range(count)]
        assert [force.force_newton for force in match.forces] == pytest.approx([1.0 + c for c in range(count)])
    # One channel alone says nothing of the K by which it was changed: its whole error stands.
    expected = math.hypot(MODEL_ERROR * 2.0, 2e-7 / abs(plate.sensitivity[4, 1]))
    assert match.forces[1].systematic_newton == pytest.approx(expected, rel=1e-6)


def alike():
    """Frequencies (3, 4) of three codes with channels alike: two of them 20 ppm apart, the third one far away."""
    return 10e6 * np.array([1.0, 1 - 20e-6, 1 - 2e-3])[:, None] * np.ones(4)


def test_channels_that_two_sites_explain_alike_are_ambiguous():
    f0 = alike()
    first_hz, far_hz = f0[0, 0] / (1 + 6.3e-6 * 5.0), f0[2, 0] / (1 + 6.3e-6 * 2.0)
    foreign, other = np.array([[first_hz] * 3 + [10.02e6], [far_hz] * 3 + [first_hz]])
    for frequency in (np.full(4, first_hz), foreign, other, np.where([True, False, False, True], other, np.nan)):
        match = Matcher(f0, np.full((3, 4), -6.3e-6), 10.0).match(frequency, *NOISE)
        assert (match.status, match.forces) == ("ambiguous", ())


def test_a_channel_that_names_one_of_two_sites_settles_it_for_the_other():
    f0 = alike()
    f0[1, 1] = 10e6 * (1 - 4e-3)  # on channel 1 the two are far apart
    matcher = Matcher(f0, np.full((3, 4), -6.3e-6), 10.0)
    frequency = f0[2] / (1 + 6.3e-6 * 2.0)
    frequency[[0, 1]] = f0[0, [0, 1]] / (1 + 6.3e-6 * 5.0)
    match = matcher.match(frequency, *NOISE)
    assert match.status == "ok"
    assert [(force.site, force.channels) for force in match.forces] == [(0, (0, 1)), (2, (2, 3))]


def test_one_of_two_touches_beyond_the_range_is_an_overload_beside_a_force():
    plate = Ladder()
    frequency = np.where([True, True, False, False], plate.loaded_hz(2, 1.0), plate.loaded_hz(7, 10.05))
    match = matcher_of(plate).match(frequency, *NOISE)
    assert match.status == "overload"
    assert [(force.site, force.status) for force in match.forces] == [(2, "ok"), (7, "overload")]
    assert match.forces[0].force_newton == pytest.approx(1.0, abs=1e-6)
    assert match.forces[1].at_least_newton == 10.0


def test_what_an_overload_and_two_sites_explain_alike_is_ambiguous():
    # Mixed signs: 64 N on one site move two channels onto the code below, the other two onto the code above.
    f0 = 10e6 * (1 - 400e-6 * np.arange(16))[:, None] * np.ones(4)
    matcher = Matcher(f0, np.tile([-6.3e-6, 6.3e-6], (16, 2)), 10.0)
    match = matcher.match(f0[5] / (1 - np.array([-6.3e-6, 6.3e-6] * 2) * 66.0), *NOISE)
    assert (match.status, match.reason.code) == ("ambiguous", "overload_or_several")
