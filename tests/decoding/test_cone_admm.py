"""Tests of least squares in the friction cone: against a projected gradient and a general optimiser."""

import numpy as np
import pytest
from scipy.optimize import minimize

from resonator_daemon.decoding.contact_physics.cone_admm import iterate, project_on_cone


@pytest.mark.parametrize("friction", [0.3, 1.0, 3.0])
def test_projection_is_the_nearest_traction_in_the_cone(friction):
    rng = np.random.default_rng(1)
    outside = rng.standard_normal((3, 40)).astype(np.float32)
    projected = project_on_cone(outside, friction)
    for before, after in zip(outside.T.astype(float), projected.T, strict=True):
        # In polar coordinates of the shear the cone is two straight bounds, which a general optimiser can take.
        best = minimize(
            lambda p, f=before: (p[0] - np.hypot(f[0], f[1])) ** 2 + (p[1] - f[2]) ** 2,
            [0.0, 1.0],
            constraints={"type": "ineq", "fun": lambda p: [friction * p[1] - p[0], p[0], p[1]]},
            options={"ftol": 1e-14},
        )
        direction = before[:2] / np.hypot(*before[:2])
        np.testing.assert_allclose(after, [*(best.x[0] * direction), best.x[1]], atol=2e-5)


def test_traction_in_the_cone_stays():
    inside = np.array([[0.1, 0.0], [0.0, -0.2], [1.0, 0.5]], np.float32)
    np.testing.assert_allclose(project_on_cone(inside, 0.5), inside, rtol=1e-6)


def quadratic(pixels: int, seed: int):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((3 * pixels, 3 * pixels))
    return root @ root.T + np.eye(3 * pixels), 3.0 * rng.standard_normal(3 * pixels)


@pytest.mark.parametrize("seed", range(4))
def test_iteration_finds_what_a_projected_gradient_finds(seed):
    pixels, friction, rho = 6, 0.5, 6.0
    hessian, right_side = quadratic(pixels, seed)
    inside = np.array([True] * 5 + [False])

    step = 1.0 / np.linalg.eigvalsh(hessian)[-1]
    slow = np.zeros((3, pixels))
    for _ in range(4000):  # each takes off a share of 1 / condition, some hundredths
        moved = slow.ravel() - step * (hessian @ slow.ravel() - right_side)
        slow = project_on_cone(moved.reshape(3, -1).astype(np.float32), friction).astype(float) * inside

    inverse = np.linalg.inv(hessian + rho * np.eye(3 * pixels)).astype(np.float32)
    start = np.zeros((3, pixels), np.float32)
    quick, _ = iterate(inverse.dot, right_side.astype(np.float32), rho, friction, inside, start, start, 400)

    np.testing.assert_allclose(quick, slow, atol=2e-4)
    assert not quick[:, 5].any()
    assert (quick[2] > 0.0).any()


def test_two_calls_go_on_where_one_would():
    hessian, right_side = quadratic(5, 9)
    inverse = np.linalg.inv(hessian + 6.0 * np.eye(15)).astype(np.float32)
    begin = (inverse.dot, right_side.astype(np.float32), 6.0, 0.5, np.ones(5, np.bool_))
    start = np.zeros((3, 5), np.float32)
    once = iterate(*begin, start, start, 7)
    twice = iterate(*begin, *iterate(*begin, start, start, 4), 3)
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
