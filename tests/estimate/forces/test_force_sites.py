from fractions import Fraction

import numpy as np
import pytest

from resonator_daemon.estimate.forces.force_sites import (
    DEFAULT_COEFFICIENTS,
    ForceSites,
    Warmth,
    cell_std_m,
    force_newton,
    hidden_fraction,
    known_coefficients,
    positions_inside,
)

SQUARE_M = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])


def sites_of(sensitivity):
    sensitivity = np.array(sensitivity, dtype=float)
    count = len(sensitivity)
    return ForceSites(
        np.full(sensitivity.shape, 1e7),
        sensitivity,
        np.zeros((count, 2)),
        np.zeros((4, 2)),
        10.0,
        Warmth(np.zeros((count, 3)), 0.0, 0.0, np.zeros(count), 5.0),
        0.015,
    )


@pytest.mark.parametrize("channels", [(0, 1, 2, 3), (1, 3), (2,)])
@pytest.mark.parametrize(
    "sensitivity", [[-6e-6] * 4, [5e-6] * 4, [-4e-6, -5e-6, -6e-6, -9e-6], [4e-6, -5e-6, 6e-6, 9e-6]]
)
def test_a_common_shift_passes_for_the_force_that_least_squares_makes_of_it(sensitivity, channels):
    chosen = np.array(sensitivity)[list(channels)]
    (newton,), *_ = np.linalg.lstsq(chosen[:, None], np.full(len(chosen), 1e-7), rcond=None)
    per_shift = sites_of([[-1.0] * 4, sensitivity]).newton_per_shift(1, channels)
    assert 1e-7 * per_shift == pytest.approx(abs(newton))


def test_coefficients_that_are_not_given_are_the_default_ones_each_by_itself():
    given = np.array([[1e-7, np.nan, 0.0], [np.nan, np.nan, np.nan]])
    known = known_coefficients(given)
    assert known.tolist() == [[1e-7, DEFAULT_COEFFICIENTS[1], 0.0], list(DEFAULT_COEFFICIENTS)]
    assert np.isnan(given[1]).all()  # the plate's own array stays as it was


@pytest.mark.parametrize("sensitivity", [Fraction(-63, 10**7), Fraction(49, 10**7)])
@pytest.mark.parametrize("force", [Fraction(1, 50), Fraction(5), Fraction(10)])
def test_eq_1_round_trip(sensitivity, force):
    f0 = Fraction(9_996_000)
    f = f0 / (1 - sensitivity * force)  # solves (f - f0) / f = K F
    assert (f - f0) / f == sensitivity * force
    arrays = [np.array([float(x)]) for x in (f0, f, sensitivity)]
    assert force_newton(*arrays)[0] == pytest.approx(float(force), rel=1e-9)


def test_positions_lie_inside_an_outline_with_a_notch_from_the_left():
    notched = np.array([[0, 0], [3, 0], [3, 3], [0, 3], [0, 2], [2, 2], [2, 1], [0, 1]], dtype=float)
    positions = positions_inside(notched)
    x, y = positions.T
    assert not ((x < 2) & (y > 1) & (y < 2)).any()
    assert len(positions) * (3 / 128) ** 2 == pytest.approx(7, rel=0.02)


def test_two_sites_hide_at_most_twice_what_one_reports():
    # A site is heard down to half the other's share: shares 1/3 and 2/3.
    bound = hidden_fraction(np.array([[-0.005, 0.0], [0.005, 0.0]]), SQUARE_M, 4.0)
    assert bound == pytest.approx([2.0, 2.0], rel=0.03)
    assert (bound <= 2.0).all()


def test_the_bound_holds_for_every_touch_that_loads_the_site_most():
    rng = np.random.default_rng(2)
    sites = rng.uniform(-0.009, 0.009, (9, 2))
    bound = hidden_fraction(sites, SQUARE_M, 4.0)
    for touch in rng.uniform(-0.01, 0.01, (3000, 2)):
        raw = ((sites - touch) ** 2).sum(axis=1) ** -2.0
        share = raw / raw.sum()
        strongest = int(share.argmax())
        assert 1 / share[strongest] - 1 <= bound[strongest] * 1.001


def test_touches_nearest_to_one_site_spread_like_a_uniform_square():
    assert cell_std_m(np.array([[0.0, 0.0]]), SQUARE_M) == pytest.approx(np.full((1, 2), 0.02 / np.sqrt(12)), rel=1e-3)


def test_cells_are_the_nearest_sites():
    spread = cell_std_m(np.array([[-0.005, 0.0], [0.005, 0.0]]), SQUARE_M)
    expected = [[0.01 / np.sqrt(12), 0.02 / np.sqrt(12)]] * 2
    assert spread == pytest.approx(np.array(expected), rel=1e-3)
