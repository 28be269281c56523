import warnings

import numpy as np
import pytest
from contact_scenes import DEPTH_M, E, Scene, centred_noise, grid_positions, scene

from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder, SiteCovariance
from resonator_daemon.estimate.surface.open_plane.prior_tables import StationaryPrior
from resonator_daemon.estimate.surface.skin import Prior

SKIN = HalfSpace(E, 0.5)
GRID = (3, 32, 32)
NOISE_STD = centred_noise(30)  # of the fixtures' decoders; scenes are scaled to reach other ratios

PRIOR = StationaryPrior(HalfSpace(2e5, 0.4), Prior(1e-3, 0.3), 1.0)
SITES = np.random.default_rng(0).uniform(-4e-3, 4e-3, (12, 2))


@pytest.fixture(scope="module")
def decoder() -> OpenPlaneDecoder:
    return OpenPlaneDecoder(SKIN, grid_positions(), DEPTH_M, NOISE_STD)


def at(truth: Scene, decibel: float) -> Scene:
    """The scene, as strong as the noise of the fixtures' decoders makes it."""
    scale = NOISE_STD / centred_noise(decibel)
    return Scene(truth.signals * scale, truth.traction * scale)


def frames(truth: Scene, draws: int = 4):
    return np.stack([truth.frame(NOISE_STD, seed) for seed in range(draws)])


def mean_error(truth: Scene, tractions) -> float:
    return float(np.mean([truth.error(traction) for traction in tractions]))


@pytest.mark.parametrize(
    ("centre_m", "decibel", "limit"),
    [
        ((0.0, 0.0), 11, 0.232),
        ((0.0, 0.0), 20, 0.176),
        ((0.0, 0.0), 30, 0.127),
        ((0.0, 0.0), 40, 0.090),
        ((5.5e-3, 0.0), 20, 0.176),
        ((5.5e-3, 0.0), 40, 0.093),
    ],
)
def test_contact_in_the_centre_and_across_the_border(decoder, centre_m, decibel: float, limit: float):
    truth = at(scene(centre_m), decibel)
    decoded = decoder.decode(frames(truth))
    assert mean_error(truth, decoded.traction_pascal) < limit
    assert (decoded.status == "ok").all()
    assert (decoded.reason == "").all()
    assert (decoded.border_contact == (centre_m[0] > 0.0)).all()
    assert decoded.chi2 == pytest.approx(np.ones(4), abs=0.1)


def test_scattered_sites_at_mixed_depths_asked_on_a_grid():
    rng = np.random.default_rng(5)
    sites = rng.uniform(-6.4e-3, 6.4e-3, (300, 2))
    depths = np.where(np.arange(300) < 150, 0.9e-3, 1.2e-3)
    truth = scene((0.0, 1e-3), positions_m=sites[:150], depth_m=0.9e-3)
    deeper = scene((0.0, 1e-3), positions_m=sites[150:], depth_m=1.2e-3)
    whole = Scene(np.hstack([truth.signals, deeper.signals]), truth.traction)
    std = centred_noise(30)
    decoder = OpenPlaneDecoder(SKIN, sites, depths, std, query_positions_m=grid_positions())
    decoded = decoder.decode(whole.frame(std, 0), displacement=True)
    assert decoded.traction_pascal.shape == decoded.traction_std_pascal.shape == (3, 1024)
    assert decoded.displacement_m is not None
    assert decoded.displacement_m.shape == (3, 1024)
    assert whole.error(decoded.traction_pascal) < 0.2
    wrong = OpenPlaneDecoder(SKIN, sites, 1.05e-3, std)
    assert wrong.decode(whole.frame(std, 0)).log_evidence < decoded.log_evidence - 20


def test_grid_form_and_dense_form_agree(decoder):
    shape = (16, 18)
    sites = grid_positions(shape)
    truth = scene((0.7e-3, 0.3e-3), positions_m=sites, direction=0.4, radius_m=1.5e-3)
    order = np.random.default_rng(0).permutation(len(sites))
    lost = np.random.default_rng(1).random((3, len(sites))) < 0.1
    std = NOISE_STD * np.array([1.0, 1.3, 0.8])
    ordered, shuffled = (OpenPlaneDecoder(SKIN, positions, DEPTH_M, std) for positions in (sites, sites[order]))
    for decibel in (11, 20, 30, 40):
        noise = std[:, None] * np.random.default_rng(2).standard_normal(truth.signals.shape)
        whole = at(truth, decibel).signals + noise
        for frame in (whole, np.where(lost, np.nan, whole)):
            one = ordered.decode(frame, displacement=True)
            other = shuffled.decode(frame[:, order], displacement=True)
            apart = np.linalg.norm(one.traction_pascal[:, order] - other.traction_pascal)
            assert apart < 0.2 * np.linalg.norm(other.traction_std_pascal)
            for a, b, limit in (
                (one.traction_std_pascal, other.traction_std_pascal, 0.1),
                (one.displacement_m, other.displacement_m, 0.04),
            ):
                assert np.linalg.norm(a[:, order] - b) < limit * np.linalg.norm(b)
            assert one.chi2 == pytest.approx(other.chi2, rel=0.12)  # the scales are apart by at most one step, of 9 %


def test_estimate_std_and_evidence_are_those_of_the_dense_gaussian():
    """Plain solves with the covariance, no eigenmodes; rows of lost signals deleted."""
    rng = np.random.default_rng(4)
    sites = rng.uniform(-3e-3, 3e-3, (60, 2))
    noise = 1e-4 * rng.uniform(0.5, 2.0, (3, 60))
    std_pascal = 900.0
    decoder = OpenPlaneDecoder(SKIN, sites, DEPTH_M, noise, prior=Prior(std_pascal=std_pascal))
    covariance = SiteCovariance(StationaryPrior(SKIN, Prior(1e-3, 0.3), std_pascal), sites, np.full(60, DEPTH_M))
    total = covariance.signals() + np.diag(noise.ravel() ** 2)
    frame = 0.9 * np.linalg.cholesky(total) @ rng.standard_normal(180)  # 0.9: a little less than the noise is no excess
    for known in (np.ones(180, np.bool_), rng.random(180) > 0.3):
        inverse = np.linalg.inv(total[np.ix_(known, known)])
        cross = covariance.surface("traction", sites)[:, known]
        expected = cross @ inverse @ frame[known]
        variance = np.repeat([0.3, 0.3, 1.0], 60) * std_pascal**2 - np.einsum("ij,jk,ik->i", cross, inverse, cross)
        decoded = decoder.decode(np.where(known, frame, np.nan).reshape(3, 60))
        assert np.linalg.norm(decoded.traction_pascal.ravel() - expected) < 0.01 * np.linalg.norm(expected)
        factor = decoded.traction_std_pascal.ravel() / np.sqrt(variance)
        widened = factor > 1.3
        assert factor[~widened] == pytest.approx(1.0, rel=0.01)
        assert factor[widened] == pytest.approx(1.6, rel=0.02)
        assert widened.reshape(3, 60).all(axis=0).sum() == widened.sum() / 3
        energy = frame[known] @ inverse @ frame[known]
        density = -0.5 * (energy - np.linalg.slogdet(inverse)[1] + known.sum() * np.log(2 * np.pi))
        assert decoded.log_evidence == pytest.approx(density, abs=0.05)
        assert decoded.chi2 == pytest.approx(energy / known.sum(), rel=1e-3)


def test_dead_sites_cost_little(decoder):
    truth = scene()
    healthy = frames(truth)
    dead = np.random.default_rng(0).permutation(1024)[:200]
    lost = healthy.copy()
    lost[:, :, dead] = np.nan
    decoded, whole = decoder.decode(lost), decoder.decode(healthy)
    assert mean_error(truth, decoded.traction_pascal) < 1.05 * mean_error(truth, whole.traction_pascal)
    assert (decoded.reason == "600 of 3072 signals lost and filled in").all()
    assert (decoded.status == "ok").all()
    away = np.linalg.norm(grid_positions(), axis=1) > 4e-3
    gone = np.isin(np.arange(1024), dead)
    std = decoded.traction_std_pascal
    assert (std[..., away & gone].mean(axis=-1) > 1.01 * std[..., away & ~gone].mean(axis=-1)).all()


def test_gain_std_is_noise_of_one_and_a_half_times_that_share_of_the_rms():
    sites = grid_positions((12, 12))
    truth = scene(positions_m=sites, radius_m=1e-3)
    std = centred_noise(30)
    frame = truth.frame(std, 0)
    noise = np.sqrt(std**2 + (1.5 * 0.1) ** 2 * np.mean(frame**2))
    told = OpenPlaneDecoder(SKIN, sites, DEPTH_M, std, gain_std=0.1).decode(frame)
    same = OpenPlaneDecoder(SKIN, sites, DEPTH_M, noise).decode(frame)
    assert told.chi2 == pytest.approx(same.chi2, rel=0.05)
    assert told.log_evidence == pytest.approx(same.log_evidence, abs=1.0)
    assert np.linalg.norm(told.traction_pascal - same.traction_pascal) < 0.05 * np.linalg.norm(same.traction_pascal)
    assert told.traction_std_pascal == pytest.approx(same.traction_std_pascal, rel=0.1)


def test_noise_declared_too_small_is_seen_and_widens_the_error_bars():
    sites = grid_positions((16, 16))
    frame = scene(positions_m=sites, radius_m=1.25e-3).frame(centred_noise(20), 0)
    told, untold = (
        OpenPlaneDecoder(SKIN, sites, DEPTH_M, centred_noise(decibel)).decode(frame) for decibel in (20, 40)
    )
    assert untold.chi2 > 50
    ratio = untold.traction_std_pascal / told.traction_std_pascal
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)


def test_anomaly_scores_are_in_standard_deviations(decoder):
    frame = frames(scene(), 1)[0]
    frame[:, 16 * 32 + 15] = np.nan  # under the contact
    scores, _ = decoder.scores_and_predictions(frame)
    assert np.flatnonzero(np.isnan(scores).all(axis=0)).tolist() == [16 * 32 + 15]
    assert (np.nanmax(np.abs(scores)), np.nanstd(scores)) == (pytest.approx(4.0, abs=1.0), pytest.approx(1.0, abs=0.05))


@pytest.mark.parametrize("decibel", [11, 20, 30, 40])
def test_error_bars(decoder, decibel: float):
    """Pooled over contacts in the middle, beside it and across the border."""
    inside, outside = [], []
    for centre in ((0.0, 0.0), (3e-3, -1e-3), (-2e-3, 2e-3), (5.5e-3, 0.0)):
        truth = at(scene(centre, direction=0.5), decibel)
        decoded = decoder.decode(frames(truth))
        score = np.abs(decoded.traction_pascal - truth.traction) / decoded.traction_std_pascal
        pressed = truth.traction[2] > 0
        inside.append(score[..., pressed].ravel())
        outside.append(score[..., ~pressed].ravel())
        assert 0.60 < np.mean(inside[-1] < 1) < 0.85
        assert 0.91 < np.mean(inside[-1] < 2) < 0.99
        assert np.mean(outside[-1] < 1) > 0.68
        assert np.mean(outside[-1] < 2) > 0.95
    assert 0.60 < np.mean(np.concatenate(inside) < 1) < 0.80
    assert 0.92 < np.mean(np.concatenate(inside) < 2) < 0.98


def test_frames_that_hold_nothing(decoder):
    frame = frames(scene(), 1)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stack = np.stack([np.full_like(frame, np.nan), frame * 1e6, frame])
        stack[1, 0, 0] = np.inf
        decoded = decoder.decode(stack.reshape(3, *GRID), displacement=True)
    assert decoded.status.tolist() == ["no_signal", "no_signal", "ok"]
    for values in (decoded.traction_pascal, decoded.traction_std_pascal, decoded.displacement_m):
        assert values is not None
        assert values.shape == (3, *GRID)
        assert np.isnan(values[:2]).all()
        assert np.isfinite(values[2]).all()
    assert decoder.decode(np.full(GRID, np.nan)).displacement_m is None
    assert np.isnan(decoder.scores_and_predictions(np.full(GRID, np.nan))).all()


def test_what_no_load_makes_is_rejected(decoder):
    decoded = decoder.decode(0.1 * np.random.default_rng(0).standard_normal(GRID))
    assert decoded.status == "rejected"
    assert np.isnan(decoded.traction_pascal).all()


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
