import numpy as np
import pytest

from resonator_daemon.estimate.forces.force_sites import DEFAULT_COEFFICIENTS, ForceSites, Warmth, known_coefficients


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
