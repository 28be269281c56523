"""The spectral Wiener inverse and the extension against dense linear algebra on a small periodic grid."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import fft
from scipy.stats import multivariate_normal

from resonator_daemon.decoding.fourier.extension import (
    ExtendedTransform,
    extension_matrix,
)
from resonator_daemon.decoding.fourier.wiener import SpectralWiener
from resonator_daemon.elastic import HalfSpace, SpectralGrid

SHAPE = (6, 8)
SIZE = 3 * SHAPE[0] * SHAPE[1]
GRID = SpectralGrid(SHAPE, 4e-4)
NOISE_STD = np.array([2e-3, 1e-3, 3e-3])
COUPLING = np.array([[0.5, 0.0, 0.0], [0.1, 0.7, 0.0], [0.0, 0.4, 1.0]], np.complex128)
BANK = np.array([1e6, 1e7, 1e8, 1e9])


def dense(per_bin: NDArray) -> NDArray:
    """Matrix (3 ny nx, 3 ny nx) of a real operator given per bin of rfft2, by pushing unit fields through it."""
    columns = np.eye(SIZE).reshape(SIZE, 3, *SHAPE)
    spectra = np.einsum("yxij,njyx->niyx", per_bin, fft.rfft2(columns))
    return fft.irfft2(spectra, s=SHAPE).reshape(SIZE, SIZE).T


@pytest.fixture(scope="module")
def problem() -> dict[str, NDArray]:
    forward = GRID.transfer_matrix(HalfSpace(2e5, 0.5), "sensor", "traction", 5e-4)
    smooth = 1.0 / (1.0 + (GRID.omega_x**2 + GRID.omega_y**2) * 1e-6)
    prior_root = smooth[..., None, None] * COUPLING
    odd = np.sin(GRID.omega_x * 4e-4) * smooth  # 0 at the Nyquist frequency, as of every real operator
    prior_root[..., 2, 0] = 0.3j * odd
    noise_std = np.broadcast_to(NOISE_STD, (*forward.shape[:2], 3))
    rng = np.random.default_rng(11)
    load = 1e4 * dense(prior_root) @ rng.standard_normal(SIZE)
    signals = dense(forward) @ load + np.repeat(NOISE_STD, SIZE // 3) * rng.standard_normal(SIZE)
    return {"forward": forward, "prior_root": prior_root, "noise_std": noise_std, "signals": signals}


def wiener(problem: dict[str, NDArray], bank: NDArray = BANK) -> SpectralWiener:
    return SpectralWiener(problem["forward"], problem["prior_root"], problem["noise_std"], GRID.multiplicity, bank)


def spectrum(signals: NDArray) -> NDArray:
    return fft.rfft2(signals.reshape(3, *SHAPE), norm="ortho").reshape(1, 3, -1)


def test_likelihood_and_posterior_are_those_of_the_joint_gaussian(problem: dict[str, NDArray]):
    noise = np.diag(np.repeat(NOISE_STD**2, SIZE // 3))
    prior_root = dense(problem["prior_root"])
    prior, forward = prior_root @ prior_root.T, dense(problem["forward"])
    evidence, chosen = [], wiener(problem).fit(spectrum(problem["signals"]), 1.0)
    for q in BANK:
        covariance = q * forward @ prior @ forward.T + noise
        evidence.append(multivariate_normal(cov=covariance).logpdf(problem["signals"]))
        decoder = wiener(problem, np.array([q]))
        fit = decoder.fit(spectrum(problem["signals"]), 1.0)
        chi2 = problem["signals"] @ np.linalg.solve(covariance, problem["signals"]) / SIZE
        assert fit.chi2 == pytest.approx(chi2, rel=1e-9)
        if chi2 < 1.0:
            assert fit.log_evidence == pytest.approx(evidence[-1], rel=1e-10)
        else:  # the noise and the prior count as larger by what is left over
            scaled = multivariate_normal(cov=chi2 * covariance).logpdf(problem["signals"])
            assert fit.log_evidence == pytest.approx(scaled, rel=1e-10)
            assert fit.excess == pytest.approx(chi2, rel=1e-9)
        gain = q * prior @ forward.T @ np.linalg.inv(covariance)
        posterior = q * prior - gain @ forward @ (q * prior)
        expected = np.diag(posterior).reshape(3, *SHAPE) * max(chi2, 1.0)
        np.testing.assert_allclose(decoder.traction_variance(fit, np.ones(SHAPE))[0], expected, rtol=1e-8)
    assert min(evidence) < max(evidence) - 10
    assert chosen.scale == 2  # the load was drawn with a standard deviation of 1e4


@pytest.mark.parametrize("bank", [np.array([1e8]), np.geomspace(1e6, 1e10, 40)])
def test_variance_grows_to_that_of_the_prior_where_nothing_is_known(problem: dict[str, NDArray], bank: NDArray):
    decoder = wiener(problem, bank)
    fit = decoder.fit(spectrum(problem["signals"]), 1.0)
    variance = decoder.traction_variance(fit, np.array([1.0, 0.5, 0.1, 0.0]))
    assert (np.diff(variance, axis=-1) > 0).all()
    prior_root = dense(problem["prior_root"])
    prior = (prior_root**2).sum(axis=1).reshape(3, -1)[:, 0] * bank[fit.scale] * fit.excess
    np.testing.assert_allclose(variance[0, :, 3], prior, rtol=2e-3)


@pytest.mark.parametrize(("shape", "side"), [((32, 32), 48), ((5, 7), 12)])
def test_extended_transform_is_that_of_the_extended_field(shape: tuple[int, int], side: int):
    transform = ExtendedTransform(shape, "taper")
    fields = np.random.default_rng(3).standard_normal((2, 3, *shape))
    extended = extension_matrix(shape[0], side) @ fields @ extension_matrix(shape[1], side).T
    spectrum = transform.to_spectrum(fields)
    expected = fft.rfft2(extended, norm="ortho").reshape(2, 3, -1)
    np.testing.assert_allclose(spectrum, expected, atol=1e-13 * np.abs(expected).max())
    np.testing.assert_allclose(transform.to_space(spectrum), fields, atol=1e-13)
    assert transform.extended_shape == (side, side)
    assert transform.samples_share == pytest.approx(shape[0] * shape[1] / side**2)
