"""The Fourier decoder on contacts whose signals come from closed forms in space."""

import numpy as np
import pytest
from contact_scenes import DEPTH_M, PITCH_M, E, Scene, fourier_decoder, grid_scene, noise_std

from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance
from resonator_daemon.estimate.surface.decoded import Decoded
from resonator_daemon.estimate.surface.fourier.decoder import FourierDecoder
from resonator_daemon.estimate.surface.skin import Prior


@pytest.fixture(scope="module")
def centred() -> Scene:
    return grid_scene()


# --- accuracy


@pytest.mark.parametrize(("decibel", "limit"), [(11, 0.25), (20, 0.19), (30, 0.14), (40, 0.10), (60, 0.08)])
def test_partial_slip_contact(centred: Scene, decibel: float, limit: float):
    decode = fourier_decoder(centred, decibel).decode
    for seed in range(4):
        decoded = decode(centred.noisy(decibel, seed))
        assert centred.error(decoded) < limit
        assert decoded.status == "ok"
        assert decoded.reason == ""
        assert not decoded.border_contact
        assert 0.9 < decoded.chi2 < (1.1 if decibel <= 40 else 2.5)


@pytest.mark.parametrize("nu", [0.0, 0.3])
@pytest.mark.parametrize("shape", [(32, 32), (24, 30)])
def test_compressible_skin_oblong_array_contact_off_centre(shape: tuple[int, int], nu: float):
    scene = grid_scene((0.9e-3, -0.5e-3), shape=shape, nu=nu, direction=2.0)
    assert scene.error(fourier_decoder(scene, 30, nu=nu).decode(scene.noisy(30, 0))) < 0.16


def test_contact_across_the_border_is_flagged_and_stays_sane():
    crossing = grid_scene((5.5e-3, 0.0))
    for decibel, limit in [(11, 0.26), (20, 0.25), (30, 0.21), (40, 0.21), (60, 0.30)]:
        decoded = fourier_decoder(crossing, decibel).decode(crossing.noisy(decibel, 0))
        assert crossing.error(decoded) < limit
        assert decoded.border_contact


@pytest.mark.parametrize("decibel", [11, 20, 30, 40])
def test_error_bars_are_right_on_average(centred: Scene, decibel: float):
    decoded = fourier_decoder(centred, decibel).decode(np.stack([centred.noisy(decibel, seed) for seed in range(4)]))
    ratio = (decoded.traction_pascal - centred.traction) / decoded.traction_std_pascal
    rms = np.sqrt(np.mean(ratio**2, axis=(0, 2, 3)))
    assert (rms > 0.6).all()
    assert (rms < 1.25).all()


def test_evidence_of_noise_is_the_density_of_white_noise(centred: Scene):
    std = noise_std(centred.signals, 30)
    frame = std * np.random.default_rng(0).standard_normal((3, 32, 32))
    gone = np.random.default_rng(1).random(frame.shape) < 0.2
    for known in (np.ones_like(gone), ~gone):
        density = -0.5 * np.log(2 * np.pi * std**2) - 0.5 * (frame[known] / std) ** 2
        decoded = fourier_decoder(centred, 30).decode(np.where(known, frame, np.nan))
        assert decoded.log_evidence == pytest.approx(density.sum(), rel=0.02)
        assert not decoded.border_contact


# --- noise of the channels, fixed scale


def test_noise_std_is_per_channel(centred: Scene):
    body, std = HalfSpace(E, 0.5), noise_std(centred.signals, 30)
    declared = std * np.array([1.0, 8.0, 1.0])
    rng = np.random.default_rng(2)
    frame = centred.signals + declared[:, None, None] * rng.standard_normal(centred.signals.shape)
    full = np.broadcast_to(declared[:, None, None], (3, 32, 32))
    found = [FourierDecoder(body, (32, 32), PITCH_M, DEPTH_M, d).decode(frame) for d in (declared, full)]
    np.testing.assert_allclose(found[0].traction_pascal, found[1].traction_pascal, rtol=1e-9, atol=1e-6)
    equal = FourierDecoder(body, (32, 32), PITCH_M, DEPTH_M, std * np.sqrt(66 / 3)).decode(frame)
    wrong = FourierDecoder(body, (32, 32), PITCH_M, DEPTH_M, declared[[0, 2, 1]]).decode(frame)
    assert centred.error(found[0]) < 0.92 * centred.error(equal)
    assert centred.error(found[0]) < 0.75 * centred.error(wrong)


def test_where_signals_are_lost_the_priors_own_deviation_holds():
    lost = np.full((3, 5, 7), np.nan)
    lost[:, :, :4] = 0.0
    blind = FourierDecoder(HalfSpace(E, 0.5), (5, 7), PITCH_M, 0.0, 10.0, prior=Prior(std_pascal=1e3)).decode(lost)
    assert blind.traction_std_pascal[:, 2, 6] == pytest.approx(1e3 * np.sqrt([0.3, 0.3, 1.0]), rel=0.01)


@pytest.mark.parametrize("nu", [0.3, 0.5])
def test_displacement_is_that_of_the_traction_on_the_open_plane(nu: float):
    scene = grid_scene(nu=nu)
    decoded = fourier_decoder(scene, 40, nu=nu).decode(scene.noisy(40, 0), displacement=True)
    expected = SurfaceCompliance(HalfSpace(E, nu), (32, 32), PITCH_M).displacement_m(decoded.traction_pascal)
    assert decoded.displacement_m is not None
    assert np.linalg.norm(decoded.displacement_m - expected) < 0.05 * np.linalg.norm(expected)


# --- lost and impossible signals


@pytest.mark.parametrize(("lost", "decibel", "limit"), [(0.01, 30, 1.02), (0.2, 40, 1.10)])
def test_scattered_losses_cost_little(centred: Scene, lost: float, decibel: float, limit: float):
    decode = fourier_decoder(centred, decibel).decode
    for seed in range(3):
        frame = centred.noisy(decibel, seed)
        whole = decode(frame)
        gone = np.random.default_rng(seed + 50).random(frame.shape) < lost
        decoded = decode(np.where(gone, [[[np.nan]], [[-np.inf]], [[10.1]]], frame))
        assert centred.error(decoded) < limit * centred.error(whole)
        assert decoded.status == "ok"
        assert decoded.reason == f"{gone.sum()} of 3072 signals lost and filled in"
        assert decoded.traction_std_pascal.mean() > (1 + 0.15 * lost) * whole.traction_std_pascal.mean()
        assert decoded.chi2 == pytest.approx(whole.chi2, rel=0.06)


@pytest.mark.parametrize(("stop", "limit"), [(18, 0.15), (21, 0.25)])
def test_hole_under_the_contact(centred: Scene, stop: int, limit: float):
    frame = centred.noisy(30, 0)
    frame[:, 14:stop, 14:stop] = np.nan
    decoded = fourier_decoder(centred, 30).decode(frame)
    assert centred.error(decoded) < limit
    std = decoded.traction_std_pascal
    assert (std[:, 15, 15] > 1.2 * std[:, 0, 0]).all()
    assert (std[:, 15, 15] > std[:, 12, 12]).all()


def assert_unknown(decoded: Decoded) -> None:
    assert decoded.displacement_m is not None
    for array in (decoded.traction_pascal, decoded.traction_std_pascal, decoded.displacement_m):
        assert array.shape == (3, 32, 32)
        assert np.isnan(array).all()
    assert decoded.border_contact is False


def test_frames_without_enough_signals_are_unknown(centred: Scene):
    decode = fourier_decoder(centred, 30).decode
    frame = centred.noisy(30, 0)
    one_channel = frame.copy()
    one_channel[1] = np.nan
    for useless in (np.full_like(frame, np.nan), frame * 1e6, one_channel):
        decoded = decode(useless, displacement=True)
        assert decoded.status == "no_signal"
        assert np.isnan(decoded.chi2)
        assert_unknown(decoded)


def test_a_frame_that_no_load_explains_is_rejected(centred: Scene):
    frame = np.random.default_rng(0).permutation(centred.noisy(30, 0).ravel()).reshape(3, 32, 32)
    decoded = fourier_decoder(centred, 30).decode(frame, displacement=True)
    assert decoded.status == "rejected"
    assert decoded.chi2 > 100
    assert_unknown(decoded)


# --- shapes


def test_a_stack_has_the_axes_of_its_frames(centred: Scene):
    decode = fourier_decoder(centred, 30).decode
    frames = np.stack([centred.noisy(30, seed) for seed in range(4)]).reshape(2, 2, 3, 32, 32)
    frames[1, 0] = np.nan
    frames[0, 1, 2, 5, 5] = np.nan
    frames[1, 1] = np.random.default_rng(0).permutation(frames[1, 1].ravel()).reshape(3, 32, 32)
    stack = decode(frames, displacement=True)
    assert stack.traction_pascal.shape == stack.traction_std_pascal.shape == (2, 2, 3, 32, 32)
    assert stack.displacement_m is not None
    for place in np.ndindex(2, 2):
        single = decode(frames[place], displacement=True)
        for name in ("traction_pascal", "traction_std_pascal", "displacement_m", "log_evidence", "chi2"):
            np.testing.assert_array_equal(getattr(stack, name)[place], getattr(single, name))
    assert stack.status.tolist() == [["ok", "ok"], ["no_signal", "rejected"]]
    assert stack.reason_code.tolist() == [["", "signals_lost"], ["signals_missing", "signals_unexplained"]]
