"""The inverse problem of a load on a known support: exponential prior inside, 0 around.

Unknown are the tractions of n pixels in units of the prior's standard deviation. Their log density given the signals is
b' g - 1/2 g' H g, H = A' A / s + C^-1; C is the correlation exp(-d / l), given 0 around, times the tangential ratio for
shear. If prior and noise stay as they were, the inverse of H + shift is updated by the pixels that left and those that
came.
"""

from collections.abc import Callable

import numpy as np
from scipy.linalg import blas, lapack

from resonator_daemon.base.arrays import Bools, Floats, Indices, Singles
from resonator_daemon.estimate.surface.contact_physics.support_rows import (
    CHANGED,
    Change,
    Model,
    SupportRows,
    joined,
    of_components,
)

_MOST_UPDATES = 30  # of an inverse, whose rounding errors add up
_RELAXATION = np.float32(1.6)
_SOLVED = 1e-3  # relative residual at which the solution without bounds is good enough
_MOST_STEPS = 60
_TINY = 1e-30


def project_on_cone(traction: Singles, friction_coefficient: float) -> Singles:
    """Return the nearest tractions (3, n) in the friction cone."""
    mu = np.float32(friction_coefficient)
    normal = traction[2]
    shear = np.sqrt(traction[0] ** 2 + traction[1] ** 2)
    on_cone = np.maximum((mu * shear + normal) / (1 + mu * mu), 0)
    slips = shear > mu * normal
    projected = np.empty_like(traction)
    scale = np.where(slips, mu * on_cone / (shear + _TINY), 1)
    np.multiply(traction[:2], scale, out=projected[:2])
    projected[2] = np.where(slips, on_cone, normal)
    return projected


class SupportProblem:
    """Matrices for one support, prior variance and noise; any frame that these fit can be solved with them.

    Parameters
    ----------
    model
    support
        Pixels that may carry load, (pixels,).
    before
        Problem of which the inverse is used as far as it is the same.
    newest_rows
        Of another support, used as far as they are the same; by default those of `before`.
    pause
        As of `ContactDecoder.rebuild`.

    Attributes
    ----------
    pixels
        Flat indices into the lattice, in any order, (n,).
    inverse
        Of H + shift, (3 n, 3 n).
    updates
        Of the inverse, since it was made from nothing.
    """

    def __init__(
        self,
        model: Model,
        support: Bools,
        before: "SupportProblem | None" = None,
        newest_rows: SupportRows | None = None,
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        self.model = model
        self.rows: SupportRows = SupportRows.of(model, support, newest_rows if before is None else before.rows)
        pause()
        self.pixels: Indices = self.rows.pixels
        self.updates = 0
        self._unit = np.float32(model.std_pascal)
        self._noise_variance = np.float32(model.noise_std**2)
        if before is not None and before.model.is_that_of(model) and before.updates < _MOST_UPDATES:
            change = Change.between(before.pixels, support)
            if change.kept.size >= (1.0 - CHANGED) * max(self.pixels.size, before.pixels.size):
                self.inverse, self.updates = self._updated(before, change), before.updates + 1
                return
        self.inverse = symmetric_inverse(self._hessian(model.shift))

    def _updated(self, before: "SupportProblem", change: Change) -> Singles:
        """Return the inverse of H + shift out of that of another problem, most of whose pixels are the same."""
        old, k, n = before.pixels.size, change.kept.size, self.pixels.size
        first, last = of_components(np.arange(k), n), of_components(np.arange(k, n), n)
        across, precision = self.rows.gram[:, last], self.rows.precision
        blocks = with_rows(
            without_rows(before.inverse, of_components(change.kept, old), of_components(change.removed, old)),
            self.model.hessian(across[first], precision[:k, k:], 0.0),
            self.model.hessian(across[last], precision[k:, k:], self.model.shift),
        )
        return joined(*blocks)

    def right_side(self, rows: Singles) -> Singles:
        """Return b of whitened rows of signals, (3 n,)."""
        return np.asarray((self.rows.rows @ rows) * (self._unit / self._noise_variance), np.float32)

    def constrained(
        self,
        right_side: Singles,
        friction_coefficient: float,
        inside: Bools,
        traction: Singles,
        multiplier: Singles,
        iterations: int,
    ) -> tuple[Singles, Singles]:
        """Minimise under Coulomb's law by the method of multipliers.

        Over-relaxed ADMM (Boyd et al., Foundations and Trends in Machine Learning 3, 2011, section 3.4.3): an iteration
        is one matrix-vector product and one projection.

        Parameters
        ----------
        right_side
            b, (3 n,).
        friction_coefficient
        inside
            Pixels that may carry load, (n,); the others are held at 0.
        traction, multiplier
            To begin with: in the friction cone, and its scaled multiplier, in Pa, (3, n).
        iterations

        Returns
        -------
        Traction and multiplier, as those given.
        """
        traction, multiplier = traction / self._unit, multiplier / self._unit
        shift, keep = np.float32(self.model.shift), inside.astype(np.float32)
        for _ in range(iterations):
            shifted = right_side + shift * (traction - multiplier).ravel()
            free = symmetric_product(self.inverse, shifted).reshape(traction.shape)
            free *= _RELAXATION
            free += multiplier - (_RELAXATION - 1) * traction
            traction = project_on_cone(free, friction_coefficient) * keep
            multiplier = free - traction
        return traction * self._unit, multiplier * self._unit

    def linear(self, right_side: Singles, inside: Bools, start: Singles) -> Singles:
        """Return the traction in Pa without bounds on the pixels inside, (3, n); conjugate gradients from a start."""
        hessian, keep = self._hessian(0.0), np.tile(inside, 3).astype(np.float32)
        solution = start.ravel() / self._unit * keep
        left = (right_side - symmetric_product(hessian, solution)) * keep
        wanted = _SOLVED * float(np.linalg.norm(right_side * keep))
        direction, product = np.zeros_like(left), 1.0
        for _ in range(_MOST_STEPS):
            if np.linalg.norm(left) <= wanted:
                break
            preconditioned = symmetric_product(self.inverse, left) * keep
            previous, product = product, float(left @ preconditioned)
            direction = np.asarray(preconditioned + product / max(previous, _TINY) * direction, np.float32)
            curved = symmetric_product(hessian, direction) * keep
            step = product / max(float(direction @ curved), _TINY)
            solution = solution + step * direction
            left = left - step * curved
        return np.asarray(solution.reshape(3, -1) * self._unit, np.float32)

    def solutions(self, right_sides: Floats) -> Floats:
        """Return the tractions in Pa without bounds on all pixels, (k, 3 n), of right sides (k, 3 n)."""
        found = lapack.spotrs(cholesky_factor(self._hessian(0.0)).T, right_sides.T.astype(np.float32), lower=0)[0]
        return np.asarray(self.model.std_pascal * found.T.astype(np.float64), np.float64)

    def chi2(self, rows: Singles, right_side: Singles, traction: Singles) -> float:
        """Return the mean square residual of whitened rows, of right side b, with a traction (3, n) in Pa."""
        loads = traction.ravel()
        explained = 2.0 * float(loads @ right_side) * float(self._noise_variance / self._unit)
        explained -= float(loads @ symmetric_product(self.rows.gram, loads))
        return (float(rows @ rows) - explained) / rows.size

    def predicted(self, traction: Singles) -> Singles:
        """Return the rows of signals under a traction (3, n), in Pa."""
        return np.asarray(traction.ravel() @ self.rows.rows, np.float32)

    def std(self) -> Singles:
        """Return the standard deviation in Pa, (3, n), with the iteration's quadratic term as information, too."""
        return np.asarray(self._unit * np.sqrt(self.inverse.diagonal()).reshape(3, -1), np.float32)

    def _hessian(self, shift: float) -> Singles:
        return self.model.hessian(self.rows.gram, self.rows.precision, shift)


def cholesky_factor(matrix: Singles) -> Singles:
    """Return the lower Cholesky factor L of a symmetric positive definite matrix.

    What stands above its diagonal has no meaning. LinAlgError if the matrix is not positive definite.
    """
    factor, failed = lapack.spotrf(matrix.T, clean=0)
    if failed:
        raise np.linalg.LinAlgError("matrix is not positive definite")
    return np.asarray(factor.T, np.float32)


def symmetric_product(matrix: Singles, right_sides: Singles) -> Singles:
    """Return a symmetric matrix times right sides (n,) or (n, k); for a single one, half of the matrix is read."""
    return blas.ssymv(1.0, matrix.T, right_sides) if right_sides.ndim == 1 else matrix @ right_sides


def without_rows(inverse_matrix: Singles, kept: Indices, removed: Indices) -> Singles:
    """Return the inverse of the matrix without some of its rows and columns, from that of the whole one."""
    rows = inverse_matrix.take(kept, axis=0)
    across = rows.take(removed, axis=1)
    factor = inverse_factor(inverse_matrix.take(removed, axis=0).take(removed, axis=1))
    half = across @ factor.T  # M_kr M_rr^-1 M_rk = half half'
    remaining: Singles = rows.take(kept, axis=1)
    remaining -= half @ half.T
    return remaining


def with_rows(inverse_matrix: Singles, across: Singles, corner: Singles) -> tuple[Singles, Singles, Singles]:
    """Return the blocks (old, old), (old, new), (new, new) of the inverse with rows and columns added.

    Parameters
    ----------
    inverse_matrix
        Of the matrix so far, (k, k).
    across, corner
        Blocks of the matrix between old and new rows (k, d), and among the new ones (d, d).
    """
    spread: Singles = inverse_matrix @ across
    factor = inverse_factor(np.asarray(corner - across.T @ spread, np.float32))
    half: Singles = spread @ factor.T
    old = np.asarray(half @ half.T, np.float32)
    old += inverse_matrix
    crossed: Singles = -(half @ factor)
    new: Singles = factor.T @ factor
    return old, crossed, new


def inverse_factor(matrix: Singles) -> Singles:
    """Return the inverse of the lower Cholesky factor of a symmetric positive definite matrix, which may be empty."""
    if not matrix.size:
        return matrix
    return np.asarray(np.tril(lapack.strtri(cholesky_factor(matrix).T)[0].T), np.float32)


def symmetric_inverse(matrix: Singles) -> Singles:
    """Return the inverse of a symmetric positive definite matrix."""
    lower = lapack.spotri(cholesky_factor(matrix).T)[0].T
    inverse: Singles = np.tril(lower)
    inverse += np.tril(lower, -1).T
    return inverse
