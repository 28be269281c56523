"""Covariance matrices of sites at mixed depths."""

import numpy as np
import pytest

from resonator_daemon.estimate.elastic import HalfSpace
from resonator_daemon.estimate.surface.open_plane.decoder import SiteCovariance
from resonator_daemon.estimate.surface.open_plane.prior_tables import StationaryPrior
from resonator_daemon.estimate.surface.prior import Prior

PRIOR = StationaryPrior(HalfSpace(2e5, 0.4), Prior(1e-3, 0.3), 1.0)
SITES = np.random.default_rng(0).uniform(-4e-3, 4e-3, (12, 2))


@pytest.mark.parametrize("distinct", [1, 3, 12])
def test_each_entry_is_the_kernel_of_its_two_depths(distinct: int):
    """Twelve distinct depths are interpolated, fewer are not."""
    depths = np.linspace(0.8e-3, 1.3e-3, distinct)[np.arange(12) % distinct]
    covariance = SiteCovariance(PRIOR, SITES, depths)
    signals = covariance.signals().reshape(3, 12, 3, 12)
    surface = {
        field: covariance.surface(field, SITES[:5]).reshape(3, 5, 3, 12) for field in ("traction", "displacement")
    }
    for i, j in [(0, 1), (3, 3), (7, 2), (4, 11)]:
        expected = PRIOR.kernel("sensor", depths[i], "sensor", depths[j], 0.02)(SITES[i] - SITES[j])
        assert np.abs(signals[:, i, :, j] - expected).max() < 1e-5 * np.abs(signals).max()
    for field, matrix in surface.items():
        expected = PRIOR.kernel(field, 0.0, "sensor", depths[9], 0.02)(SITES[4] - SITES[9])
        assert np.abs(matrix[:, 4, :, 9] - expected).max() < 1e-5 * np.abs(matrix).max()


def test_signals_have_a_covariance():
    matrix = SiteCovariance(PRIOR, SITES, np.linspace(0.7e-3, 1.4e-3, 12)).signals()
    assert matrix == pytest.approx(matrix.T, abs=1e-9 * matrix.max())
    assert np.linalg.eigvalsh(matrix).min() > -1e-6 * matrix.max()
