"""The likelihood of scales against the dense Gaussian density."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from resonator_daemon.decoding.open_plane.scale_grid import ScaleGrid

COUNT, MODES = 40, 12
RNG = np.random.default_rng(3)
VECTORS = np.linalg.qr(RNG.standard_normal((COUNT, MODES)))[0]
EIGENVALUES = np.geomspace(3.0, 0.01, MODES)
NOISE = RNG.uniform(0.5, 2.0, COUNT)
SCALES = np.geomspace(1e-2, 1e6, 81)
BANK = ScaleGrid(EIGENVALUES, SCALES, np.log(NOISE))


def covariance(scale: float, factor: float = 1.0):
    return factor * NOISE[:, None] * (scale * (VECTORS * EIGENVALUES) @ VECTORS.T + np.eye(COUNT)) * NOISE


def choose(signals, floor: float = 1.0):
    whitened = signals / NOISE
    return BANK.choose((VECTORS.T @ whitened).astype(np.float32), float(whitened @ whitened), floor)


def energy_and_level(signals, scale: float) -> tuple[float, float]:
    """Mahalanobis' square and the logarithm of the determinant."""
    dense = covariance(scale)
    return float(signals @ np.linalg.solve(dense, signals)), float(np.linalg.slogdet(dense)[1])


def density(signals, scale: float, factor: float) -> float:
    return float(multivariate_normal(cov=covariance(scale, factor)).logpdf(signals))


@pytest.mark.parametrize("scale", [1.0, 50.0, 3e3])
@pytest.mark.parametrize("factor", [0.7, 1.0, 9.0])
def test_scale_and_excess_of_largest_density(scale: float, factor: float):
    signals = np.linalg.cholesky(covariance(scale, factor)) @ np.random.default_rng(7).standard_normal(COUNT)
    found = choose(signals)
    assert found.log_evidence == pytest.approx(density(signals, SCALES[found.scale], found.excess), abs=1e-3)
    # A factor f of the covariance divides the energy, and adds log f to the determinant's logarithm for each signal.
    energy, level = np.transpose([energy_and_level(signals, q) for q in SCALES])[..., None]
    factors = np.geomspace(1.0, 20.0, 13)
    best = np.max(-0.5 * (energy / factors + level + COUNT * np.log(2.0 * np.pi * factors)))
    assert found.log_evidence > best - 0.5
    whitened = np.linalg.solve(np.linalg.cholesky(covariance(SCALES[found.scale])), signals)
    assert found.chi2 == pytest.approx(np.mean(whitened**2), rel=1e-4)
    assert found.excess == pytest.approx(max(found.chi2, 1.0))


def test_floor_counts_as_noise():
    signals = np.linalg.cholesky(covariance(100.0)) @ RNG.standard_normal(COUNT)
    found = choose(3.0 * signals, floor=9.0)
    assert found.scale == choose(signals).scale
    assert found.excess == pytest.approx(9.0 * max(found.chi2, 1.0))
    assert found.log_evidence == pytest.approx(density(3.0 * signals, SCALES[found.scale], found.excess), abs=1e-3)


def test_noise_alone_has_the_smallest_scale():
    rest = RNG.standard_normal(COUNT)
    assert choose(NOISE * (rest - VECTORS @ (VECTORS.T @ rest))).scale == 0
