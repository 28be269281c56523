"""The inverse problem of a load on a known support: exponential prior inside, 0 around.

Unknown are the tractions of n pixels in units of the prior's standard deviation. Their log density given the signals is
b' g - 1/2 g' H g, H = A' A / s + C^-1; C is the correlation exp(-d / l), given 0 around, times the tangential ratio for
shear.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from resonator_daemon.decoding.contact_physics.cone_admm import iterate
from resonator_daemon.decoding.contact_physics.signal_rows import LostRows

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Mask = NDArray[np.bool_]
Reals = TypeVar("Reals", Singles, Floats)

_RHO = 6.0  # of the method of multipliers, over the inverse prior variance of f_z
_SOLVED = 1e-3  # relative residual at which the support-linear solution is good enough
_MOST_STEPS = 60
_SMALL = 64  # rows of a matrix that is not worth halving


class SupportProblem:
    """Matrices for one support, prior variance and noise; any frame that these fit can be solved with them.

    Parameters
    ----------
    kernel
        Rows of signals under 1 Pa on each pixel of the lattice, (3, pixels, rows).
    centres_m
        Of those pixels, (pixels, 2).
    support
        Pixels that may carry load, (pixels,).
    around
        Pixels that are known to carry none, near enough to tell something about those that do, (pixels,).
    std_pascal
        Prior standard deviation of f_z.
    noise_std
        Of each row.
    correlation_length_m, tangential_ratio
        l, and the power of f_x and of f_y over that of f_z.
    lost
        Of the signals that are lost, if any.
    """

    def __init__(
        self,
        kernel: Singles,
        centres_m: Floats,
        support: Mask,
        around: Mask,
        std_pascal: float,
        noise_std: float,
        correlation_length_m: float,
        tangential_ratio: float,
        lost: LostRows | None,
    ) -> None:
        self.support = support
        self.pixels = np.flatnonzero(support)
        self.std_pascal = std_pascal
        self.noise_std = noise_std
        self.lost = lost
        count = self.pixels.size
        rows = kernel[:, self.pixels].reshape(3 * count, -1)
        if lost is not None:
            rows = lost.kernel(rows)
        self._rows: Singles = np.ascontiguousarray(rows * np.float32(std_pascal))
        both = centres_m[np.concatenate([self.pixels, np.flatnonzero(around)])]
        correlation = np.exp(-cdist(both, both) / correlation_length_m)
        precision = _inverse(correlation)[:count, :count].astype(np.float32)  # given that there is 0 around
        self._hessian: Singles = (self._rows @ self._rows.T) / np.float32(noise_std**2)
        for component, ratio in enumerate((tangential_ratio, tangential_ratio, 1.0)):
            block = slice(component * count, (component + 1) * count)
            self._hessian[block, block] += precision / np.float32(ratio)
        shifted: Singles = self._hessian.copy()
        shifted.ravel()[:: 3 * count + 1] += np.float32(_RHO)
        self._inverse: Singles = _inverse(shifted)

    def right_side(self, rows: Singles) -> Singles:
        """Return b of whitened rows of signals, (3 n,)."""
        return (self._rows @ rows) / np.float32(self.noise_std**2)

    def constrained(
        self,
        right_side: Singles,
        friction_coefficient: float,
        inside: Mask,
        traction: Singles,
        multiplier: Singles,
        iterations: int,
    ) -> tuple[Singles, Singles]:
        """Traction in the friction cone and its multiplier, in Pa, (3, n), from those to begin with."""
        unit = np.float32(self.std_pascal)
        traction, multiplier = iterate(
            self._inverse,
            right_side,
            _RHO,
            friction_coefficient,
            inside,
            np.asarray(traction / unit, np.float32),
            np.asarray(multiplier / unit, np.float32),
            iterations,
        )
        return traction * unit, multiplier * unit

    def linear(self, right_side: Singles, inside: Mask, start: Singles) -> Singles:
        """Traction in Pa without bounds, on the pixels inside, (3, n), by conjugate gradients from a `start`."""
        unit = np.float32(self.std_pascal)
        keep = np.tile(inside, 3).astype(np.float32)
        solution = start.ravel() / unit * keep
        left = (right_side - self._hessian @ solution) * keep
        wanted = _SOLVED * float(np.linalg.norm(right_side * keep))
        direction, product = np.zeros_like(left), 1.0
        for _ in range(_MOST_STEPS):
            if float(np.linalg.norm(left)) <= wanted:
                break
            preconditioned = (self._inverse @ left) * keep
            previous, product = product, float(left @ preconditioned)
            direction = preconditioned + np.float32(product / previous) * direction
            curved = (self._hessian @ direction) * keep
            step = np.float32(product / float(direction @ curved))
            solution += step * direction
            left -= step * curved
        return solution.reshape(3, -1) * unit

    def solutions(self, right_sides: Floats) -> Floats:
        """Tractions in Pa without bounds on all pixels, (k, 3 n), of right sides (k, 3 n), to single precision."""
        found = np.linalg.solve(self._hessian, right_sides.T.astype(np.float32))
        return self.std_pascal * found.T.astype(np.float64)

    def chi2(self, rows: Singles, traction: Singles) -> float:
        """Mean square of what a traction (3, n), in Pa, leaves of whitened rows."""
        left = rows - self.predicted(traction)
        return float(left @ left) / rows.size

    def predicted(self, traction: Singles) -> Singles:
        """Rows of signals under a traction (3, n), in Pa."""
        return np.asarray((traction.ravel() / np.float32(self.std_pascal)) @ self._rows, np.float32)

    def std(self) -> Singles:
        """Return the standard deviation in Pa, (3, n), with the iteration's quadratic term as information, too."""
        return np.float32(self.std_pascal) * np.sqrt(np.diag(self._inverse)).reshape(3, -1)


def _inverse(matrix: Reals) -> Reals:
    """Of a symmetric positive definite matrix.

    By numpy alone: scipy's LAPACK calls would keep other threads waiting.
    """
    factor = _inverse_factor(matrix)
    inverse: Reals = factor.T @ factor
    return inverse


def _inverse_factor(matrix: Reals) -> Reals:
    """Inverse of Cholesky's lower factor, by halves, so that nearly all of it is products of matrices."""
    count = len(matrix)
    if count <= _SMALL:
        smallest: Reals = np.linalg.inv(np.linalg.cholesky(matrix))
        return smallest
    half = count // 2
    factor = np.zeros_like(matrix)
    factor[:half, :half] = _inverse_factor(matrix[:half, :half])
    across = matrix[half:, :half] @ factor[:half, :half].T
    factor[half:, half:] = _inverse_factor(matrix[half:, half:] - across @ across.T)
    factor[half:, :half] = -(factor[half:, half:] @ across) @ factor[:half, :half]
    return factor
