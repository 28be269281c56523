import math

import numpy as np
import pytest
from brute_force_board import Ladder
from drawn_touches import MODEL_ERROR, NOISE, draws, match_all, matcher_of

from resonator_daemon.base.plate import load_plate
from resonator_daemon.estimate.forces.site_identification import Matcher


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


def test_three_channels_that_two_sites_explain_alike_are_ambiguous():
    f0, matcher = alike(20e-6)
    frequency = f0[0] / (1 + 6.3e-6 * 5.0)
    frequency[3] = 10.02e6
    match = matcher.match(frequency, *NOISE)
    assert (match.status, match.forces, match.candidates) == ("ambiguous", (), (0, 1))


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


def alike(spacing):
    """Three codes with channels alike: two of them `spacing` apart, the third one far away."""
    f0 = 10e6 * np.array([1.0, 1 - spacing, 1 - 2e-3])[:, None] * np.ones(4)
    return f0, Matcher(f0, np.full((3, 4), -6.3e-6), 10.0)


def test_a_channel_that_alone_fits_two_sites_is_ambiguous():
    f0, matcher = alike(20e-6)
    frequency = f0[2] / (1 + 6.3e-6 * 2.0)
    frequency[3] = f0[0, 3] / (1 + 6.3e-6 * 5.0)
    match = matcher.match(frequency, *NOISE)
    assert (match.status, match.forces, match.candidates) == ("ambiguous", (), (0, 1, 2))
    two = np.where([True, False, False, True], frequency, np.nan)
    match = matcher.match(two, *NOISE)
    assert (match.status, match.forces, match.candidates) == ("ambiguous", (), (0, 1, 2))


def test_a_channel_that_names_one_of_two_sites_settles_it_for_the_other():
    f0, matcher = alike(20e-6)
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
    assert match.status == "ambiguous"
    assert match.candidates == (4, 5, 6)
