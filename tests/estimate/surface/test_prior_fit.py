"""The prior found from frames: drawn from a known prior, and of contacts."""

import numpy as np
import pytest
from contact_scenes import DEPTH_M, E, grid_positions

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.open_plane.prior_fit import fit_prior, has_load
from resonator_daemon.estimate.surface.skin import Prior

SKIN = HalfSpace(E, 0.5)
SITES_M = grid_positions((8, 8))
SCATTERED_M = np.random.default_rng(0).uniform(-2e-3, 2e-3, (60, 2))


def traction_waves(sites_m: Floats, length_m: float, ratio: float, count: int, rng: np.random.Generator) -> Floats:
    """Signals (count, 3, n) under loads of 500 plane waves each, whose directions and lengths follow the prior.

    A power spectrum 1 / (1 + omega^2 l^2)^2 over the plane puts a share 1 / (1 + omega^2 l^2) beyond omega.
    """
    waves = 500
    frames = np.empty((count, 3, len(sites_m)))
    for frame in frames:
        omega = np.sqrt(1.0 / rng.uniform(1e-3, 1.0, waves) - 1.0) / length_m
        angle = rng.uniform(0.0, 2.0 * np.pi, waves)
        x, y = omega * np.cos(angle), omega * np.sin(angle)
        matrix = SKIN.transfer_matrix("sensor", "traction", x, y, DEPTH_M)
        load = rng.standard_normal((waves, 3)) * np.sqrt([ratio, ratio, 1.0])
        phase = np.exp(
            1j * (np.outer(sites_m[:, 0], x) + np.outer(sites_m[:, 1], y) + rng.uniform(0, 2 * np.pi, waves))
        )
        frame[:] = np.einsum("nw,wij,wj->in", phase, matrix, load).real
    return frames


def noisy(frames: Floats, decibel: float, rng: np.random.Generator) -> tuple[Floats, float]:
    std = float(np.sqrt(np.mean(frames**2)) * 10.0 ** (-decibel / 20.0))
    return frames + std * rng.standard_normal(frames.shape), std


@pytest.mark.parametrize(
    ("sites_m", "length_m", "ratio"),
    [pytest.param(SITES_M, 1.5e-3, 0.1, marks=pytest.mark.soak), (SCATTERED_M, 0.6e-3, 0.8)],
)
def test_recovers_the_prior_that_loads_are_drawn_from(sites_m: Floats, length_m: float, ratio: float) -> None:
    rng = np.random.default_rng(1)
    loads = traction_waves(sites_m, length_m, ratio, 30, rng) * rng.uniform(0.5, 2.0, (30, 1, 1))
    frames, std = noisy(loads, 30.0, rng)
    empty = std * rng.standard_normal((4, *frames.shape[1:]))
    lost = np.full((2, *frames.shape[1:]), np.nan)
    told: list[tuple[int, float, float]] = []
    found = fit_prior(
        SKIN, sites_m, DEPTH_M, np.concatenate([empty, frames, lost]), std, progress=lambda *step: told.append(step)
    )
    assert found.frames_used == 30
    assert abs(found.correlation_length_m - length_m) < 3.0 * found.correlation_length_std_m < 0.5 * length_m
    assert abs(found.tangential_ratio - ratio) < 3.0 * found.tangential_ratio_std < 0.6 * ratio
    assert [tried for tried, _, _ in told] == list(range(2, len(told) + 2))
    assert len(told) < 40

    def evidence(length_m: float, ratio: float) -> float:
        decoder = OpenPlaneDecoder(SKIN, sites_m, DEPTH_M, std, prior=Prior(length_m, ratio))
        return float(np.sum(decoder.decode(frames).log_evidence))

    best = evidence(found.correlation_length_m, found.tangential_ratio)
    assert best - evidence(1e-3, 0.3) == pytest.approx(
        found.log_evidence_gain, abs=0.05 * found.log_evidence_gain + 1.0
    )
    assert best > max(evidence(1.3 * length_m, ratio), evidence(length_m / 1.3, ratio))


def test_what_frames_do_not_bound_has_an_infinite_error() -> None:
    """An even load over all sites is longer than any prior tried, and without shear."""
    frame = np.zeros((2, 3, 25))
    frame[:, 0] = -1.0
    found = fit_prior(SKIN, grid_positions((5, 5)), DEPTH_M, frame, 1e-3)
    assert np.isinf([found.correlation_length_std_m, found.tangential_ratio_std]).any()
    assert np.isfinite([found.correlation_length_m, found.tangential_ratio, found.log_evidence_gain]).all()


def test_load_is_energy_beyond_noise() -> None:
    noise = np.random.default_rng(3).standard_normal((1000, 3, 100))
    assert np.count_nonzero(has_load(noise, 1.0)) <= 1
    assert has_load(1.3 * noise, 1.0).mean() > 0.9
    by_channel = noise * np.array([1.0, 2.0, 3.0])[:, None]
    assert np.count_nonzero(has_load(by_channel, [1.0, 2.0, 3.0])) <= 1
    noise[:, :, 40:] = np.nan
    noise[:, 0, 0] = np.inf
    assert np.count_nonzero(has_load(noise, 1.0)) <= 1


def test_the_spectrum_of_the_prior_has_unit_variance() -> None:
    omega = np.linspace(0.0, 1e5, 200_001)  # of a Prior of 1 mm: it has faded by 1e-8 at the end
    power = Prior().spectrum_m2(omega**2) * omega / (2.0 * np.pi)
    assert power.sum() * (omega[1] - omega[0]) == pytest.approx(1.0, rel=1e-3)
