"""Stick radius and margin to slip from single frames, whose truth comes from closed forms in space."""

from dataclasses import replace

import numpy as np
import pytest
from contact_scenes import DEPTH_M, NU, SITES_M, Contact, E, disc_model, noise_std, noisy

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart, Friction, PartialSlip, stick_ratio
from resonator_daemon.estimate.surface.fitting.slip_fitter import fit_partial_slip

SCENE = Contact((3e-4, -1.1e-3), 2.4e-3, 0.6, 0.8)


@pytest.fixture(scope="module")
def discs() -> DiscModel:
    return disc_model()


def about(scene: Contact, friction: Friction | None = None) -> ContactStart:
    x, y = scene.centre_m
    return ContactStart((x + 4e-4, y - 3e-4), 1.2 * scene.radius_m, friction=friction)


def one(discs: DiscModel, signals: Floats, noise: float, scene: Contact, friction: Friction | None) -> PartialSlip:
    return fit_partial_slip(discs, signals, noise, [about(scene, friction)])[0]


@pytest.mark.parametrize("friction", [None, Friction(0.5), Friction(0.5, 0.02)])
@pytest.mark.parametrize("ratio", [0.02, 0.3, 0.6, 0.9])
def test_recovers_a_frame_without_noise(discs: DiscModel, friction: Friction | None, ratio: float) -> None:
    scene = replace(SCENE, stick_ratio=ratio)
    found = one(discs, scene.signals, noise_std(scene.signals, 60.0), scene, friction)
    assert (found.status, found.reason) == ("ok", None)
    np.testing.assert_allclose(found.centre_m, scene.centre_m, atol=1e-6)
    np.testing.assert_allclose(found.radius_m, scene.radius_m, rtol=1e-3)
    np.testing.assert_allclose(found.force_newton, scene.force_newton, atol=1e-3)
    np.testing.assert_allclose(found.slip_margin, ratio**3, atol=3e-3)
    np.testing.assert_allclose(found.friction_coefficient, 0.5, rtol=1e-2)


@pytest.mark.parametrize(
    ("friction", "decibel", "limit"), [(Friction(0.5), 11.0, 0.03), (Friction(0.5), 30.0, 0.005), (None, 20.0, 0.025)]
)
def test_noisy_frames_with_honest_errors(
    discs: DiscModel, friction: Friction | None, decibel: float, limit: float
) -> None:
    rng = np.random.default_rng(1)
    ratios, scores, radii = [], [], []
    for _ in range(24):
        scene = Contact.random(rng)
        found = one(discs, noisy(scene.signals, decibel, rng), noise_std(scene.signals, decibel), scene, friction)
        ratios.append(found.stick_ratio - scene.stick_ratio)
        radii.append(found.radius_m / scene.radius_m - 1.0)
        truth = np.array([*scene.centre_m, scene.radius_m, *scene.force_newton, scene.stick_ratio**3])
        estimate = np.array([*found.centre_m, found.radius_m, *found.force_newton, found.slip_margin])
        scores.append((estimate - truth) / np.sqrt(np.diag(found.covariance)))
    assert np.sqrt(np.mean(np.square(ratios))) <= limit
    assert np.sqrt(np.mean(np.square(radii))) <= 0.01
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert ((rms > 0.6) & (rms < 1.5)).all()


def test_gross_slip_beyond_the_friction_given_is_seen(discs: DiscModel) -> None:
    scene = replace(SCENE, stick_ratio=0.0, mu=0.3)
    found = one(discs, scene.signals, noise_std(scene.signals, 30.0), scene, Friction(0.5, 0.05))
    assert found.slip_margin < 0.02
    assert found.friction_coefficient == pytest.approx(0.3, rel=0.02)


@pytest.mark.parametrize("decibel", [11.0, 20.0, 30.0])
def test_without_shear_the_margin_is_unknown_and_the_pose_is_not(discs: DiscModel, decibel: float) -> None:
    scene = replace(SCENE, stick_ratio=1.0)
    rng = np.random.default_rng(5)
    for _ in range(6):
        found = one(discs, noisy(scene.signals, decibel, rng), noise_std(scene.signals, decibel), scene, None)
        assert found.status == "unknown"
        assert np.isnan([found.slip_margin, found.stick_ratio, found.friction_coefficient]).all()
        assert found.radius_m == pytest.approx(scene.radius_m, rel=0.03)


def test_another_shape_is_unknown(discs: DiscModel) -> None:
    flat = DiscModel(HalfSpace(E, NU), SITES_M, DEPTH_M, 3e-3, "flat").signals(np.zeros(2), 2.5e-3).value
    signals = flat[2] + 0.2 * flat[0]
    found = fit_partial_slip(discs, signals, noise_std(signals, 30.0), [ContactStart((2e-4, 0.0), 2e-3)])[0]
    assert found.status == "unknown"
    assert np.isnan([*found.force_newton, found.radius_m, found.slip_margin]).all()


@pytest.mark.parametrize("factor", [np.nan, 1e6])
def test_a_frame_out_of_all_bounds_is_unknown(discs: DiscModel, factor: float) -> None:
    found = fit_partial_slip(discs, factor * (SCENE.signals + 1e-4), 1e-4, [about(SCENE)])[0]
    assert found.status == "unknown"
    assert np.isnan(found.force_newton).all()


def test_stick_ratio_near_gross_slip_has_a_wide_error() -> None:
    assert stick_ratio(0.125, 0.0) == (0.5, 0.0)
    ratio, std = stick_ratio(0.0, 0.008)
    assert ratio == 0.0
    assert std == pytest.approx(0.1)
