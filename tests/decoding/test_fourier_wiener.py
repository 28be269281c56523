"""The spectral Wiener inverse and the extension against dense linear algebra on a small periodic grid."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import fft
from scipy.sparse.linalg import lsqr
from scipy.stats import multivariate_normal

from resonator_daemon.decoding.fourier.extension import (
    ExtendedTransform,
    extended_length,
    extension_matrix,
    noise_power,
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


def in_space(spectrum: NDArray) -> NDArray:
    return fft.irfft2(spectrum.reshape(3, SHAPE[0], -1), s=SHAPE, norm="ortho").ravel()


@pytest.mark.parametrize("q", BANK)
def test_estimate_is_the_regularised_least_squares_solution(problem: dict[str, NDArray], q: float):
    decoder = wiener(problem, np.array([q]))
    fit = decoder.fit(spectrum(problem["signals"]), 1.0)
    scaled_prior = np.sqrt(q) * dense(problem["prior_root"])
    noise = np.repeat(NOISE_STD, SIZE // 3)
    forward = dense(problem["forward"])
    solution = lsqr(
        (forward @ scaled_prior) / noise[:, None], problem["signals"] / noise, damp=1.0, atol=1e-14, btol=1e-14
    )[0]
    expected = scaled_prior @ solution
    np.testing.assert_allclose(in_space(decoder.tractions(fit)), expected, atol=1e-10 * np.abs(expected).max())
    predicted = forward @ expected
    np.testing.assert_allclose(in_space(decoder.signals(fit)), predicted, atol=1e-10 * np.abs(predicted).max())


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


def test_extension_repeats_the_edges_and_tapers_to_zero():
    values = np.array([3.0, 1.0, 2.0, 5.0, 4.0, 1.0, 6.0, 2.0])
    extended = extension_matrix(8, 12) @ values
    np.testing.assert_array_equal(extended[:8], values)
    assert 2.0 > extended[8] > extended[9] > 0.0
    assert 3.0 > extended[11] > extended[10] > 0.0
    long = extension_matrix(8, 48) @ values
    np.testing.assert_array_equal(long[10:46], 0.0)
    np.testing.assert_array_equal(extension_matrix(5, 6) @ values[:5], [*values[:5], 0.0])


@pytest.mark.parametrize(("count", "length"), [(32, 48), (1, 2), (16, 24), (64, 96), (33, 50), (400, 600)])
def test_extended_length(count: int, length: int):
    assert extended_length(count) == length


def test_noise_power_is_what_extended_noise_shows():
    matrix = extension_matrix(16, 24)
    noise = np.random.default_rng(5).standard_normal((16, 20000))
    measured = (np.abs(fft.fft(matrix @ noise, axis=0, norm="ortho")) ** 2).mean(axis=1)
    np.testing.assert_allclose(noise_power(matrix), measured, rtol=0.06)
    np.testing.assert_allclose(noise_power(matrix).sum(), (matrix**2).sum())


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


@pytest.mark.parametrize("shape", [(6, 8), (5, 7)])
def test_periodic_transform_extends_nothing(shape: tuple[int, int]):
    transform = ExtendedTransform(shape, "periodic")
    fields = np.random.default_rng(3).standard_normal((3, *shape))
    expected = fft.rfft2(fields, norm="ortho").reshape(3, -1)
    np.testing.assert_allclose(transform.to_spectrum(fields), expected, atol=1e-13)
    np.testing.assert_allclose(transform.to_space(expected), fields, atol=1e-13)
    np.testing.assert_allclose(transform.noise_power, 1.0)
    assert transform.extended_shape == shape
    assert transform.samples_share == 1.0
