"""Shapes told apart by their signals; truth from summed point loads and closed forms in space."""

import numpy as np
import pytest
from contact_scenes import DEPTH_M, NU, SITES_M, Contact, E, disc_model, hertz, noise_std, noisy

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart
from resonator_daemon.estimate.surface.fitting.shape import ShapeFitter
from resonator_daemon.estimate.surface.fitting.slip_fitter import fit_partial_slip

START = ContactStart((1e-4, -4e-4), 2.2e-3)


@pytest.fixture(scope="module")
def fitter() -> ShapeFitter:
    return ShapeFitter(HalfSpace(E, NU), SITES_M, DEPTH_M, 6e-3)


def flat_face(centre_m: Floats, radius_m: float, force: Floats, moments: Floats) -> Floats:
    """Rings at r = a sin(angle) under F / (2 pi a^2) (1 + 3 T . r / (F a^2)) / sqrt(1 - r^2 / a^2)."""
    nodes, weights = np.polynomial.legendre.leggauss(14)
    total = np.zeros((3, len(SITES_M)))
    for angle, weight in zip((nodes + 1.0) * np.pi / 4.0, weights * np.pi / 4.0, strict=True):
        for turn in np.arange(24) * 2.0 * np.pi / 24.0:
            offset = radius_m * np.sin(angle) * np.array([np.cos(turn), np.sin(turn)])
            load = force + np.array([0.0, 0.0, 3.0 * (moments @ offset) / radius_m**2])
            total += (
                weight * np.sin(angle) / 24.0 * np.einsum("f,fsn->sn", load, hertz(SITES_M, centre_m + offset, 0.0))
            )
    return total


def line(centre_m: Floats, half_length_m: float, direction_rad: float, force: Floats) -> Floats:
    nodes, weights = np.polynomial.legendre.leggauss(40)
    along = half_length_m * np.array([np.cos(direction_rad), np.sin(direction_rad)])
    total = np.zeros((3, len(SITES_M)))
    for node, weight in zip(nodes, weights, strict=True):
        total += weight / 2.0 * np.einsum("f,fsn->sn", force, hertz(SITES_M, centre_m + node * along, 0.0))
    return total


@pytest.mark.parametrize("decibel", [11.0, 20.0, 30.0])
def test_paraboloid(fitter: ShapeFitter, decibel: float) -> None:
    scene = Contact((3e-4, -1e-3), 2.5e-3, 0.5, 1.0)
    found = fitter.fit(
        noisy(scene.signals, decibel, np.random.default_rng(1)), noise_std(scene.signals, decibel), START
    )
    assert found.kind == "paraboloid"
    # R = 4 E a^3 / (3 F (1 - nu^2)), depth a^2 / R
    curvature = 4.0 * E * 2.5e-3**3 / (3.0 * 0.75)
    assert found.radius_m == pytest.approx(2.5e-3, rel=0.01)
    assert abs(found.radius_of_curvature_m - curvature) < 3.0 * found.radius_of_curvature_std_m < 0.08 * curvature
    assert abs(found.indentation_m - 2.5e-3**2 / curvature) < 3.0 * found.indentation_std_m < 8e-5
    assert np.isnan([*found.tilt_rad, found.direction_rad, found.length_m]).all()


def test_curvature_and_depth_scatter_as_they_say(fitter: ShapeFitter) -> None:
    scene = Contact((3e-4, -1e-3), 2.5e-3, 0.5, 1.0)
    noise = noise_std(scene.signals, 20.0)
    found = fitter.fit(scene.signals, noise, START)
    slip = fit_partial_slip(disc_model(), scene.signals, noise, [START])[0]
    pairs = np.random.default_rng(2).multivariate_normal(
        [slip.radius_m, slip.force_newton[2]], slip.covariance[np.ix_([2, 5], [2, 5])], 20000, method="eigh"
    )
    curvatures = 4.0 * E * pairs[:, 0] ** 3 / (3.0 * 0.75 * pairs[:, 1])
    assert found.radius_of_curvature_std_m == pytest.approx(curvatures.std(), rel=0.05)
    assert found.indentation_std_m == pytest.approx((pairs[:, 0] ** 2 / curvatures).std(), rel=0.05)


@pytest.mark.parametrize("decibel", [11.0, 30.0])
def test_tilted_flat_face(fitter: ShapeFitter, decibel: float) -> None:
    force, moments = np.array([0.1, 0.05, 1.0]), np.array([2e-4, -1e-4])
    signals = flat_face(np.array([2e-4, -5e-4]), 2e-3, force, moments)
    frame = noisy(signals, decibel, np.random.default_rng(3))
    frame[1, 7] = 1e6  # no signal
    found = fitter.fit(frame, noise_std(signals, decibel), START)
    assert found.kind == "flat"
    assert found.radius_m == pytest.approx(2e-3, rel=0.01)
    np.testing.assert_allclose(found.centre_m, [2e-4, -5e-4], atol=3e-5)
    np.testing.assert_allclose(found.force_newton, force, atol=0.03)
    # depth F (1 - nu^2) / (2 E a); slope 3 T (1 - nu^2) / (4 E a^3)
    assert found.indentation_m == pytest.approx(0.75 / (2.0 * E * 2e-3), rel=0.02)
    np.testing.assert_allclose(
        found.tilt_rad, 0.75 * 0.75 * moments / (E * 2e-3**3), atol=0.02 if decibel < 20 else 2e-3
    )
    assert np.isnan(found.radius_of_curvature_m)


@pytest.mark.parametrize("direction", [0.0, 0.7, 2.6])
def test_edge(fitter: ShapeFitter, direction: float) -> None:
    force = np.array([0.1, 0.0, 1.0])
    signals = line(np.array([5e-4, 0.0]), 3e-3, direction, force)
    found = fitter.fit(noisy(signals, 20.0, np.random.default_rng(4)), noise_std(signals, 20.0), START)
    assert found.kind == "edge"
    assert abs((found.direction_rad - direction + np.pi / 2.0) % np.pi - np.pi / 2.0) < 4.0 * found.direction_std_rad
    assert found.direction_std_rad < 0.01
    assert found.length_m == pytest.approx(6e-3, rel=0.01)
    np.testing.assert_allclose(found.force_newton, force, atol=0.01)


def test_two_contacts_are_another_shape(fitter: ShapeFitter) -> None:
    signals = (
        Contact((3.5e-3, -1e-3), 1.5e-3, 0.5, 1.0).signals + 0.5 * Contact((-3e-3, 2e-3), 1.5e-3, 0.5, 2.0).signals
    )
    found = fitter.fit(noisy(signals, 30.0, np.random.default_rng(5)), noise_std(signals, 30.0), START)
    assert found.kind == "other"
    assert np.isnan([found.radius_m, *found.centre_m, *found.force_newton]).all()
    assert set(found.log_evidence) == {"paraboloid", "flat", "edge"}
