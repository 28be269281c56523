"""The inverse problem of a load on a known support: exponential prior inside, 0 around.

Unknown are the tractions of n pixels in units of the prior's standard deviation. Their log density given the signals is
b' g - 1/2 g' H g, H = A' A / s + C^-1; C is the correlation exp(-d / l), given 0 around, times the tangential ratio for
shear.
"""

import numpy as np

from resonator_daemon.arrays import Bools, Floats, Indices, Singles
from resonator_daemon.decoding.contact_physics.cone_admm import iterate
from resonator_daemon.decoding.contact_physics.inverse import symmetric_product
from resonator_daemon.decoding.contact_physics.support_matrices import Model, SupportMatrices, SupportRows

_SOLVED = 1e-3  # relative residual at which the support-linear solution is good enough
_MOST_STEPS = 60
_TINY = np.float32(1e-30)


class SupportProblem:
    """Matrices for one support, prior variance and noise; any frame that these fit can be solved with them.

    Parameters
    ----------
    model
    support
        Indices that may carry load, (pixels,).
    before
        Problem of which the inverse is taken over as far as it is the same.
    newest_rows
        Of another support, taken over as far as they are the same; by default those of `before`.
    """

    def __init__(
        self,
        model: Model,
        support: Bools,
        before: "SupportProblem | None" = None,
        newest_rows: SupportRows | None = None,
    ) -> None:
        self.model = model
        matrices: SupportMatrices | None = None if before is None else before.matrices
        rows = SupportRows.of(model, support, newest_rows if matrices is None else matrices.of_rows)
        self.matrices: SupportMatrices = SupportMatrices(model, rows, matrices)
        self.rows = rows
        self.pixels: Indices = rows.pixels
        ratio = model.tangential_ratio
        self._ratios = np.array([[ratio], [ratio], [1.0]], np.float32)
        self._unit = np.float32(model.std_pascal)
        self._noise_variance = np.float32(model.noise_std**2)
        self._power = np.float32((model.std_pascal / model.noise_std) ** 2)

    def prepare(self) -> None:
        """Compute what makes many frames quicker, and takes longer than one."""
        self.matrices.prepare()

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
        """Return the traction in the friction cone and its multiplier, in Pa, (3, n), from those to begin with."""
        unit = self._unit
        traction, multiplier = iterate(
            self.matrices.shifted_solution,
            right_side,
            self.model.shift,
            friction_coefficient,
            inside,
            traction / unit,
            multiplier / unit,
            iterations,
        )
        return traction * unit, multiplier * unit

    def linear(self, right_side: Singles, inside: Bools, start: Singles) -> Singles:
        """Return the traction in Pa without bounds, on the pixels inside, (3, n), from a `start`."""
        keep = np.tile(inside, 3).astype(np.float32)
        found = self._solve(right_side[None] * keep, keep, start.reshape(1, -1) / self._unit * keep, _SOLVED)
        return np.asarray(found.reshape(3, -1) * self._unit, np.float32)

    def solutions(self, right_sides: Floats) -> Floats:
        """Return the tractions in Pa without bounds on all pixels, (k, 3 n), of right sides (k, 3 n)."""
        given = right_sides.T.astype(np.float32)
        return self.model.std_pascal * self.matrices.solution(given).T.astype(np.float64)

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
        return self._unit * np.sqrt(self.matrices.variance()).reshape(3, -1)

    def _product(self, loads: Singles) -> Singles:
        """H times loads (k, 3 n)."""
        prior = (loads.reshape(len(loads), 3, -1) @ self.rows.precision) / self._ratios
        product: Singles = (loads @ self.rows.gram) * self._power + prior.reshape(loads.shape)
        return product

    def _solve(self, right_sides: Singles, keep: Singles, solution: Singles, precision: float) -> Singles:
        """Return loads (k, 3 n) of least squares where `keep` (3 n,) is 1, by conjugate gradients from a solution."""
        left = right_sides - self._product(solution) * keep
        wanted = precision * np.linalg.norm(right_sides, axis=1)
        direction, product = np.zeros_like(left), np.ones((len(left), 1), np.float32)
        for _ in range(_MOST_STEPS):
            if (np.linalg.norm(left, axis=1) <= wanted).all():
                break
            preconditioned = self.matrices.shifted_solution(left.T).T * keep
            previous, product = product, np.vecdot(left, preconditioned)[:, None]
            direction = preconditioned + product / np.maximum(previous, _TINY) * direction
            curved = self._product(direction) * keep
            step = product / np.maximum(np.vecdot(direction, curved)[:, None], _TINY)
            solution = solution + step * direction
            left = left - step * curved
        return solution
