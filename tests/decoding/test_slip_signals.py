"""Signals of a contact in partial slip against closed forms in space, their slopes against differences of those."""

from dataclasses import replace

import numpy as np
import pytest
from contact_scenes import DEPTH_M, NU, SITES_M, Contact, E, contact_signals, disc_model

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.fitting.contact_model import DiscModel
from resonator_daemon.decoding.fitting.slip_problem import MARGIN
from resonator_daemon.elastic import HalfSpace

SCENE = Contact((3e-4, -1.1e-3), 2.4e-3, 0.6, 0.8)


@pytest.fixture(scope="module")
def discs() -> DiscModel:
    return disc_model()


def parameters(scene: Contact) -> Floats:
    return np.array([*scene.centre_m, scene.radius_m, *scene.force_newton, scene.stick_ratio**3])


def in_space(contact: Floats, depth_m: float, nu: float, sites_m: Floats) -> Floats:
    """Signals (3 n,) of x, y, a, F_x, F_y, F_z, m by closed forms, double precision."""
    radius_m, force, margin = contact[2], contact[3:6], contact[6]
    mu = np.hypot(*force[:2]) / (force[2] * (1.0 - margin))
    return contact_signals(sites_m, force, contact[:2], radius_m, friction=mu, depth_m=depth_m, nu=nu).ravel()


@pytest.mark.parametrize("ratio", [0.02, 0.3, 0.6, 0.985, 0.9999])
def test_values_and_slopes_as_in_space(discs: DiscModel, ratio: float) -> None:
    contact = parameters(replace(SCENE, stick_ratio=ratio))
    value, slopes = discs.slip.signals(contact)
    expected = in_space(contact, DEPTH_M, NU, SITES_M)
    assert np.linalg.norm(value - expected) < 1e-4 * np.linalg.norm(expected)
    exact = []
    for index in range(7):
        step = np.zeros(7)
        step[index] = 1e-4 * (min(contact[6], 1.0 - contact[6]) if index == MARGIN else contact[index])
        ahead, behind = (in_space(contact + sign * step, DEPTH_M, NU, SITES_M) for sign in (1.0, -1.0))
        exact.append((ahead - behind) / (2.0 * step[index]))
        assert np.linalg.norm(slopes[index] - exact[index]) < 0.02 * np.linalg.norm(exact[index])
    # Error bars that follow are good to a percent.
    prior = np.diag([0.0] * 6 + [1e-4])
    stds = [np.sqrt(np.diag(np.linalg.inv(part @ part.T + prior))) for part in (slopes, np.array(exact))]
    np.testing.assert_allclose(stds[0], stds[1], rtol=0.01)


def test_mixed_depths_and_compressible() -> None:
    depths = np.random.default_rng(0).choice([0.8e-3, 1.0e-3, 1.3e-3], len(SITES_M))
    mixed = DiscModel(HalfSpace(E, 0.3), SITES_M, depths, 3e-3).slip
    contact = parameters(SCENE)
    value, slopes = mixed.signals(contact)
    for depth in np.unique(depths):
        at = depths == depth
        expected = in_space(contact, depth, 0.3, SITES_M).reshape(3, -1)[:, at]
        assert np.abs(value.reshape(3, -1)[:, at] - expected).max() < 1e-4 * np.abs(expected).max()
        alone = DiscModel(HalfSpace(E, 0.3), SITES_M, depth, 3e-3).slip.signals(contact)[1]
        for found, other in zip(slopes.reshape(7, 3, -1)[..., at], alone.reshape(7, 3, -1)[..., at], strict=True):
            assert np.linalg.norm(found - other) < 0.02 * np.linalg.norm(other)
