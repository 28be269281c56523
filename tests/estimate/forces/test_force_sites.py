import numpy as np
import pytest

from resonator_daemon.estimate.forces import force_sites

SQUARE_M = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])

# Tones in the order of frequency; sites 2, 0, 1, of which 0 and 2 have a thermometer, too.
SITE = np.array([2, 0, 0, 2, 1])
SIGNAL = np.array([0, 1, 0, 1, 0])
FORCE_TONE = {0: 2, 1: 4, 2: 0}
WARM_TONE = {0: 1, 2: 3}
PULL = np.array([0.0, 2e-5, -1e-5, 1.5e-5])
F0_HZ = (9.9e6 + 4000.0 * np.arange(5))[:, None] * (1 + PULL)
SENSITIVITY = np.where(SIGNAL == 0, -6e-6, 9e-6)[:, None] * np.array([1.0, 1.2, 0.8, 1.1])
SENSITIVITY[4] *= -1  # site 1: a press raises its frequency
OSCILLATOR_HZ = 9.9e6 + 4000.0 * np.arange(5) + 37.0
SIGMA = np.full((4, 5), 0.01)


def sites_of(sensitivity):
    sensitivity = np.array(sensitivity, dtype=float)
    count = len(sensitivity)
    return force_sites.ForceSites(
        np.full(sensitivity.shape, 1e7),
        sensitivity,
        np.zeros((count, 2)),
        np.zeros((4, 2)),
        10.0,
        force_sites.Warmth(np.zeros((count, 3)), 0.0, 0.0, np.zeros(count), 5.0),
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
    known = force_sites.known_coefficients(given)
    assert known.tolist() == [[1e-7, force_sites.DEFAULT_COEFFICIENTS[1], 0.0], list(force_sites.DEFAULT_COEFFICIENTS)]
    assert np.isnan(given[1]).all()  # the plate's own array stays as it was


def test_positions_lie_inside_an_outline_with_a_notch_from_the_left():
    notched = np.array([[0, 0], [3, 0], [3, 3], [0, 3], [0, 2], [2, 2], [2, 1], [0, 1]], dtype=float)
    positions = force_sites.positions_inside(notched)
    x, y = positions.T
    assert not ((x < 2) & (y > 1) & (y < 2)).any()
    assert len(positions) * (3 / 128) ** 2 == pytest.approx(7, rel=0.02)


def test_two_sites_hide_at_most_twice_what_one_reports():
    # A site is heard down to half the other's share: shares 1/3 and 2/3.
    bound = force_sites.hidden_fraction(np.array([[-0.005, 0.0], [0.005, 0.0]]), SQUARE_M, 4.0)
    assert bound == pytest.approx([2.0, 2.0], rel=0.03)
    assert (bound <= 2.0).all()


def test_the_bound_holds_for_every_touch_that_loads_the_site_most():
    rng = np.random.default_rng(2)
    sites = rng.uniform(-0.009, 0.009, (9, 2))
    bound = force_sites.hidden_fraction(sites, SQUARE_M, 4.0)
    for touch in rng.uniform(-0.01, 0.01, (3000, 2)):
        raw = ((sites - touch) ** 2).sum(axis=1) ** -2.0
        share = raw / raw.sum()
        strongest = int(share.argmax())
        assert 1 / share[strongest] - 1 <= bound[strongest] * 1.001


@pytest.mark.parametrize(("sites_m", "width_m"), [([[0.0, 0.0]], 0.02), ([[-0.005, 0.0], [0.005, 0.0]], 0.01)])
def test_touches_nearest_to_a_site_spread_uniformly_in_its_rectangle(sites_m, width_m):
    expected = np.array([[width_m, 0.02]] * len(sites_m)) / np.sqrt(12)
    assert force_sites.cell_std_m(np.array(sites_m), SQUARE_M) == pytest.approx(expected, rel=1e-3)


def tones():
    return force_sites.ForceTones(F0_HZ, SENSITIVITY, OSCILLATOR_HZ, SITE, SIGNAL)


def offsets_hz(force=(0.0, 0.0, 0.0), warmer=(0.0, 0.0, 0.0)):
    """Offsets (4, t): force tones by (f - f0) / f = K F, temperature tones by f = f0 (1 + s d)."""
    hz = np.empty((5, 4))
    for tone, (site, signal) in enumerate(zip(SITE, SIGNAL, strict=True)):
        k = SENSITIVITY[tone]
        hz[tone] = F0_HZ[tone] * (1 + k * warmer[site]) if signal else F0_HZ[tone] / (1 - k * force[site])
    return hz.T - OSCILLATOR_HZ


def test_forces_come_back_site_by_site_whatever_the_order_of_the_tones():
    force = np.array([1.5, 4.0, 0.25])
    shifts = tones().shifts(offsets_hz(force), SIGMA)
    assert shifts.shift / shifts.sensitivity == pytest.approx(force, rel=1e-6)
    assert shifts.shift[1] > 0 > shifts.shift[0]


def test_thermometers_tell_kelvin_where_there_are_any():
    shifts = tones().shifts(offsets_hz(warmer=(7.0, 3.0, -2.0)), SIGMA)
    assert shifts.kelvin[[0, 2]] == pytest.approx([7.0, -2.0], rel=1e-4)
    assert np.isnan(shifts.kelvin[1])
    assert shifts.shift == pytest.approx(np.zeros(3), abs=1e-12)


def test_corners_count_by_their_variance():
    rng = np.random.default_rng(0)
    sigma = np.array([0.02, 0.05, 0.3, 2.0])[:, None] * np.ones(5)
    draws = [tones().shifts(offsets_hz() + sigma * rng.standard_normal((4, 5)), sigma) for _ in range(4000)]
    scatter = np.std([draw.shift for draw in draws], axis=0)
    best = 1 / np.sqrt((1 / (sigma[:, 0] / 9.9e6) ** 2).sum())  # no unbiased mean has less
    assert scatter == pytest.approx(np.full(3, best), rel=0.05)
    assert np.sqrt(draws[0].variance) == pytest.approx(np.full(3, best), rel=3e-3)
    assert np.mean([draw.shift for draw in draws], axis=0) == pytest.approx(np.zeros(3), abs=5 * best / 4000**0.5)


def test_corners_that_are_not_known_are_left_out():
    force = np.array([1.5, 4.0, 0.25])
    sigma, offset = SIGMA.copy(), offsets_hz(force)
    offset[0, FORCE_TONE[0]] = np.nan
    sigma[1, FORCE_TONE[0]] = np.nan
    sigma[2, FORCE_TONE[0]] = 0.0
    offset[2, FORCE_TONE[0]] = 300.0  # of no weight
    shifts = tones().shifts(offset, sigma)
    assert shifts.shift / shifts.sensitivity == pytest.approx(force, rel=1e-6)
    assert shifts.sensitivity[0] == SENSITIVITY[FORCE_TONE[0], 3]
    assert shifts.variance[0] == pytest.approx(4 * shifts.variance[1], rel=0.01)


def test_a_site_that_no_corner_hears_is_not_known_and_leaves_the_others():
    offset = offsets_hz((1.0, 1.0, 1.0))
    offset[:, FORCE_TONE[2]] = np.nan
    shifts = tones().shifts(offset, SIGMA)
    assert np.isnan([shifts.shift[2], shifts.variance[2]]).all()
    assert np.isfinite(shifts.shift[:2]).all()
    assert shifts.kelvin[2] == pytest.approx(0.0, abs=1e-6)
    offset[:, WARM_TONE[2]] = np.nan
    assert np.isnan(tones().shifts(offset, SIGMA).kelvin[2])
