"""The Fourier decoder as printed, as a weighted-norm filter, with given spectra and for a sliding contact."""

from typing import Any

import numpy as np
import pytest
from contact_scenes import DEPTH_M, PITCH_M, E, Scene, fourier_decoder, grid_scene, noise_std
from scipy import fft
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from resonator_daemon.base.arrays import Complexes, Floats
from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.fourier.decoder import FourierDecoder
from resonator_daemon.estimate.surface.fourier.wiener import prior_root
from resonator_daemon.estimate.surface.skin import Prior

SKIN = HalfSpace(E, 0.5)
ODD = (5, 7)  # no Nyquist frequencies


@pytest.fixture(scope="module")
def centred() -> Scene:
    return grid_scene()


def dense(per_bin: Complexes, shape: tuple[int, int]) -> Floats:
    """Matrix of a real operator given for each bin of rfft2, by pushing unit fields through it."""
    size = 3 * shape[0] * shape[1]
    spectra = np.einsum("yxij,njyx->niyx", per_bin, fft.rfft2(np.eye(size).reshape(size, 3, *shape)))
    return np.asarray(fft.irfft2(spectra, s=shape).reshape(size, size).T, np.float64)


def transfer(shape: tuple[int, int], depth_m: float = DEPTH_M) -> Complexes:
    return SpectralGrid(shape, PITCH_M).transfer_matrix(SKIN, "sensor", "traction", depth_m)


def filtered(per_bin: Complexes, frame: Floats) -> Floats:
    spectrum = np.moveaxis(fft.rfft2(frame), 0, -1)[..., None]
    return np.asarray(fft.irfft2(np.moveaxis((per_bin @ spectrum)[..., 0], -1, 0), s=frame.shape[1:]), np.float64)


# --- as printed


@pytest.mark.parametrize("decibel", [11, 20, 30, 40])
def test_the_printed_recipe_is_a_setting(centred: Scene, decibel: float):
    """Eq. (5) as it stands: [q T* T + N]^-1 q T* s; the noise has one power, where that is right."""
    std, frame, power = noise_std(centred.signals, decibel), centred.noisy(decibel, 0), np.mean(centred.traction**2)
    forward = transfer((32, 32))
    adjoint = forward.conj().swapaxes(-1, -2)
    expected = filtered(np.linalg.inv(power * adjoint @ forward + std**2 * np.eye(3)) @ (power * adjoint), frame)
    printed = fourier_decoder(
        centred, decibel, extension="periodic", spectra="white", prior=Prior(std_pascal=np.sqrt(power))
    )
    found = printed.decode(frame)
    np.testing.assert_allclose(found.traction_pascal, expected, atol=1e-10 * np.abs(expected).max())
    assert centred.error(found) > 1.3 * centred.error(fourier_decoder(centred, decibel).decode(frame))


def test_displacement_of_a_periodic_load_on_an_oblong_array():
    """A cosine pressure indents by 2 (1 - nu^2) / (E omega) times itself; its level does not."""
    shape, nu = (24, 30), 0.3
    x = np.arange(30) * PITCH_M
    omega = 2 * np.pi * 2 / (30 * PITCH_M)
    pressure = np.zeros((3, *shape))
    pressure[2] = 1e3 + 2e3 * np.cos(omega * x)
    body = HalfSpace(E, nu)
    forward = SpectralGrid(shape, PITCH_M).transfer_matrix(body, "sensor", "traction", DEPTH_M)
    plain = FourierDecoder(
        body, shape, PITCH_M, DEPTH_M, 1e-6, extension="periodic", spectra="white", prior=Prior(std_pascal=1e15)
    )
    found = plain.decode(filtered(forward, pressure), displacement=True)
    assert found.displacement_m is not None
    expected = 2 * (1 - nu**2) / (E * omega) * 2e3 * np.cos(omega * x)
    np.testing.assert_allclose(
        found.displacement_m[2], np.broadcast_to(expected, shape), atol=1e-6 * np.abs(expected).max()
    )


# --- weights and spectra


def coupled_weights(omega_x: Floats, omega_y: Floats) -> Complexes:
    """1 + omega^2 l^2 for each component, and the square of a sum of slopes and of f_z."""
    length = 5e-4
    slopes = np.stack(np.broadcast_arrays(1j * omega_x * length, 1j * omega_y * length, 1.0), axis=-1)
    plain = 1.0 + (omega_x**2 + omega_y**2) * length**2
    return plain[..., None, None] * np.eye(3) + slopes.conj()[..., None] * slopes[..., None, :]


def inverse_weights(omega_x: Floats, omega_y: Floats):
    return np.linalg.inv(coupled_weights(omega_x, omega_y))


def test_weighted_norm_is_the_minimum_of_tikhonovs_functional():
    """|T f - s|^2 + alpha f* H f, minimised by dense linear algebra in space."""
    std, prior_std = 2e-3, 3e4
    grid = SpectralGrid(ODD, PITCH_M)
    weights = coupled_weights(grid.omega_x, grid.omega_y)
    mean_power = np.sum(grid.multiplicity * np.linalg.inv(weights)[..., 2, 2].real) / (ODD[0] * ODD[1])
    alpha = std**2 * mean_power / prior_std**2
    forward, norm = dense(transfer(ODD), ODD), dense(weights, ODD)
    frame = 5e-3 * np.random.default_rng(1).standard_normal((3, *ODD))
    expected = np.linalg.solve(forward.T @ forward + alpha * norm, forward.T @ frame.ravel()).reshape(frame.shape)
    keywords: dict[str, Any] = {"extension": "periodic", "prior": Prior(std_pascal=prior_std)}
    decoder = FourierDecoder(SKIN, ODD, PITCH_M, DEPTH_M, std, spectra=inverse_weights, **keywords)
    found = decoder.decode(frame)
    np.testing.assert_allclose(found.traction_pascal, expected, atol=1e-9 * np.abs(expected).max())
    plain = FourierDecoder(SKIN, ODD, PITCH_M, DEPTH_M, std, spectra="white", **keywords).decode(frame)
    assert np.abs(plain.traction_pascal - expected).max() > 0.1 * np.abs(expected).max()


def test_spectra_count_up_to_a_factor_and_name_the_standard_deviation(centred: Scene):
    def smooth(omega_x: Floats, omega_y: Floats) -> Floats:
        return 7e5 / (1 + (omega_x**2 + omega_y**2)[..., None] * 1e-6) ** 2 * [0.3, 0.3, 1.0]

    frame = centred.noisy(30, 0)
    for keywords in ({}, {"prior": Prior(std_pascal=1e4)}):
        own = fourier_decoder(centred, 30, **keywords).decode(frame)
        given = fourier_decoder(centred, 30, spectra=smooth, **keywords).decode(frame)
        np.testing.assert_allclose(given.traction_pascal, own.traction_pascal, rtol=1e-9, atol=1e-6)
        assert given.log_evidence == pytest.approx(own.log_evidence, rel=1e-12)
    lost = np.full((3, 3, *ODD), np.nan)[0]
    lost[:, :, :4] = 0.0  # the columns beyond are unknown: there the prior's own deviation holds
    blind = FourierDecoder(SKIN, ODD, PITCH_M, 0.0, 10.0, spectra=smooth, prior=Prior(std_pascal=1e3)).decode(lost)
    assert blind.traction_std_pascal[2, 2, 6] == pytest.approx(1e3, rel=0.01)


def test_a_nyquist_frequency_stands_for_both_its_signs():
    """Spectra that differ between omega_x and -omega_x at one omega_y, on an even array: still a real operator."""

    def slanted(omega_x: Floats, omega_y: Floats) -> Floats:
        return np.exp(-(((omega_x - omega_y) * PITCH_M / 2) ** 2))[..., None] * np.ones(3)

    def power(x: int, y: int) -> float:
        return float(np.exp(-(((x / 6 - y / 4) * np.pi) ** 2)))

    root = prior_root(slanted, SpectralGrid((4, 6), PITCH_M))[..., 0, :]
    found = (np.abs(root) ** 2).sum(axis=-1)
    expected = np.array([[power(x, y) for x in range(4)] for y in (0, 1, -2, -1)])
    expected[:, 3] = [(power(3, y) + power(-3, y)) / 2 for y in (0, 1, -2, -1)]
    expected[2] = [(power(x, 2) + power(x, -2)) / 2 for x in range(4)]
    np.testing.assert_allclose(found / found[0, 0], expected, rtol=1e-12)
    assert found @ [1, 2, 2, 1] @ np.ones(4) == pytest.approx(24)  # of unit variance in space


# --- sliding contacts


def test_sliding_is_a_mixture_of_gaussians_over_the_directions():
    """Evidence, mean and variance of 36 dense Gaussian models, their moments by averaging over angles."""
    mu, std, prior_std, sectors = 0.4, 4e-3, 2e3, 36
    size = ODD[0] * ODD[1]
    forward = dense(transfer(ODD, 5e-4), ODD)
    rng = np.random.default_rng(4)
    normal = prior_std * rng.standard_normal(size)
    load = np.concatenate([mu * np.cos(2.0) * normal, mu * np.sin(2.0) * normal, normal])
    signals = forward @ load + 0.8 * std * rng.standard_normal(3 * size)
    evidence, means, variances = [], [], []
    for sector in range(sectors):
        angles = (sector + (np.arange(200) + 0.5) / 200 - 0.5) * 2 * np.pi / sectors
        ways = np.array([mu * np.cos(angles), mu * np.sin(angles), np.ones(200)])
        prior = prior_std**2 * np.kron(ways @ ways.T / 200, np.eye(size))
        covariance = forward @ prior @ forward.T + std**2 * np.eye(3 * size)
        gain = prior @ forward.T @ np.linalg.inv(covariance)
        evidence.append(multivariate_normal(cov=covariance).logpdf(signals))
        means.append(gain @ signals)
        variances.append(np.diag(prior - gain @ forward @ prior))
    weights = np.exp(evidence - logsumexp(evidence))
    assert np.sort(weights)[-3] > 0.03  # several directions matter
    mean = weights @ np.array(means)
    between = (weights @ (np.array(means) - mean) ** 2).reshape(3, size).mean(axis=1)
    within = (weights @ np.array(variances)).reshape(3, size)
    assert (between > 0.02 * within.mean(axis=1)).any()

    found = FourierDecoder(
        SKIN,
        ODD,
        PITCH_M,
        5e-4,
        std,
        extension="periodic",
        spectra="white",
        prior=Prior(std_pascal=prior_std),
        sliding_friction=mu,
    ).decode(signals.reshape(3, *ODD))
    assert found.chi2 < 1.0
    assert found.log_evidence == pytest.approx(logsumexp(evidence) - np.log(sectors), abs=1e-3)
    np.testing.assert_allclose(found.traction_pascal.ravel(), mean, atol=2e-3 * np.abs(mean).max())
    np.testing.assert_allclose(
        found.traction_std_pascal.reshape(3, size), np.sqrt(within + between[:, None]), rtol=5e-3
    )
