"""Projected conjugate gradients against active-set solvers, dense algebra and the conditions of optimality."""

import numpy as np
import pytest
from scipy.optimize import nnls

from resonator_daemon.arrays import Floats
from resonator_daemon.elastic.constrained import (
    Bounds,
    Friction,
    Minimum,
    NotConvergedError,
    Prescribed,
    Pushing,
    minimise,
)

SHAPE = (4, 5)


def random_compliance(rng: np.random.Generator, components: int, condition: float = 1e3) -> Floats:
    """Symmetric positive matrix of no structure: its inverse has entries of both signs, unlike an elastic body's."""
    size = components * SHAPE[0] * SHAPE[1]
    basis, _ = np.linalg.qr(rng.normal(size=(size, size)))
    matrix = (basis * np.geomspace(1.0 / condition, 1.0, size)) @ basis.T
    return (matrix + matrix.T) / 2


def solve(
    matrix: Floats, target: Floats, bounds: Bounds, start: Floats, sums: Floats | None = None, tolerance: float = 1e-10
) -> Minimum:
    return minimise(
        lambda f: (matrix @ f.ravel()).reshape(f.shape),
        target,
        bounds,
        start,
        self_compliance=float(np.diag(matrix).mean()),
        precondition=lambda push: push,
        sums=sums,
        tolerance=tolerance,
    )


@pytest.mark.parametrize("seed", range(40))
def test_pushing_agrees_with_an_active_set_solver(seed: int):
    rng = np.random.default_rng(seed)
    matrix = random_compliance(rng, 1)
    target = rng.normal(size=(1, *SHAPE))
    found = solve(matrix, target, Pushing(np.ones(SHAPE, bool)), np.abs(rng.normal(size=target.shape)))
    lower = np.linalg.cholesky(matrix)
    expected, _ = nnls(lower.T, np.linalg.solve(lower, target.ravel()))
    np.testing.assert_allclose(found.tractions.ravel(), expected, atol=1e-6 * np.abs(expected).max())
    assert (found.tractions >= 0).all()
    assert not found.shift.any()


@pytest.mark.parametrize("seed", range(20))
def test_pushing_with_a_given_sum_meets_its_conditions(seed: int):
    rng = np.random.default_rng(seed)
    matrix, allowed = random_compliance(rng, 1), rng.random(SHAPE) < 0.8
    target = rng.normal(size=(1, *SHAPE))
    found = solve(matrix, target, Pushing(allowed), np.ones((1, *SHAPE)), sums=np.array([7.0]))
    f = found.tractions.ravel()
    slack = target.ravel() + float(found.shift[0, 0, 0]) - matrix @ f
    assert f.sum() == pytest.approx(7.0, rel=1e-12)
    assert (f[~allowed.ravel()] == 0).all()
    np.testing.assert_allclose(slack[f > 0], 0.0, atol=1e-8)
    assert (slack[(f == 0) & allowed.ravel()] <= 1e-8).all()


@pytest.mark.parametrize("direction", [None, (0.6, -0.8), (0.6, np.nan)])
@pytest.mark.parametrize("seed", range(20))
def test_friction_meets_its_conditions(seed: int, direction: tuple[float, float] | None):
    """Inside its disc a traction has no slack; on the rim slack and traction point the same way."""
    rng = np.random.default_rng(seed)
    matrix = random_compliance(rng, 2, condition=100.0)
    limit = np.where(rng.random(SHAPE) < 0.2, 0.0, rng.random(SHAPE))
    target = rng.normal(size=(2, *SHAPE))
    sums = None if direction is None else 0.5 * limit.sum() * np.array(direction)
    found = solve(matrix, target, Friction(limit), np.zeros((2, *SHAPE)), sums)
    f = found.tractions
    slack = target + found.shift - (matrix @ f.ravel()).reshape(f.shape)
    modulus = np.hypot(*f)
    assert (modulus <= limit * (1 + 1e-12)).all()
    inside = modulus < limit * (1 - 1e-9)
    np.testing.assert_allclose(slack[:, inside], 0.0, atol=1e-7)
    rim = ~inside & (limit > 0)
    assert rim.any()
    across = f[0] * slack[1] - f[1] * slack[0]
    np.testing.assert_allclose(across[rim], 0.0, atol=1e-7)
    assert ((f * slack).sum(axis=0)[rim] >= -1e-7).all()
    if sums is not None:
        given = np.isfinite(sums)
        np.testing.assert_allclose(f.sum(axis=(1, 2))[given], sums[given], rtol=1e-11)
        assert not found.shift[~given].any()


@pytest.mark.parametrize("seed", range(5))
def test_prescribed_agrees_with_dense_algebra(seed: int):
    rng = np.random.default_rng(seed)
    matrix = random_compliance(rng, 3, condition=100.0)
    free, values, target = rng.random((3, *SHAPE)) < 0.6, rng.normal(size=(3, *SHAPE)), rng.normal(size=(3, *SHAPE))
    found = solve(matrix, target, Prescribed(values, free), np.zeros((3, *SHAPE)))
    np.testing.assert_array_equal(found.tractions[~free], values[~free])
    mask = free.ravel()
    known = target.ravel()[mask] - matrix[np.ix_(mask, ~mask)] @ values.ravel()[~mask]
    expected = np.linalg.solve(matrix[np.ix_(mask, mask)], known)
    np.testing.assert_allclose(found.tractions.ravel()[mask], expected, rtol=1e-6, atol=1e-8)
    summed = solve(matrix, target, Prescribed(values, free), values, sums=np.array([1.0, -2.0, 3.0]))
    np.testing.assert_allclose(summed.tractions.sum(axis=(1, 2)), [1.0, -2.0, 3.0], atol=1e-11)
    slack = target + summed.shift - (matrix @ summed.tractions.ravel()).reshape(target.shape)
    np.testing.assert_allclose(slack[free], 0.0, atol=1e-7)


def test_out_of_reach_is_an_error_with_its_history():
    rng = np.random.default_rng(0)
    matrix = random_compliance(rng, 1)
    with pytest.raises(NotConvergedError, match=r"residual stays at .* must reach 1e-30") as caught:
        solve(
            matrix, rng.normal(size=(1, *SHAPE)), Pushing(np.ones(SHAPE, bool)), np.ones((1, *SHAPE)), tolerance=1e-30
        )
    assert min(caught.value.residuals) < 1e-12
    with pytest.raises(NotConvergedError, match="after 4 iterations"):
        minimise(
            lambda f: (matrix @ f.ravel()).reshape(f.shape),
            rng.normal(size=(1, *SHAPE)),
            Pushing(np.ones(SHAPE, bool)),
            np.ones((1, *SHAPE)),
            self_compliance=1.0,
            precondition=lambda push: push,
            iterations_max=3,
        )


def test_the_last_residual_is_of_a_fresh_product():
    """What the updates of A f gathered in rounding must not certify the answer."""
    rng = np.random.default_rng(0)
    matrix = random_compliance(rng, 1)
    asked: list[Floats] = []

    def compliance(f: Floats) -> Floats:
        asked.append(f.copy())
        return (matrix @ f.ravel()).reshape(f.shape)

    found = minimise(
        compliance,
        rng.normal(size=(1, *SHAPE)),
        Pushing(np.ones(SHAPE, bool)),
        np.ones((1, *SHAPE)),
        self_compliance=1.0,
        precondition=lambda push: push,
    )
    np.testing.assert_array_equal(asked[-1], found.tractions)
