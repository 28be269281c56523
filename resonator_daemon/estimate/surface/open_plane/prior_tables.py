"""Covariances between signals at depth and what happens on the surface, under a stationary prior of the traction.

The traction's prior is a Gaussian field on the infinite plane with power spectrum P = 4 pi l^2 q diag(r, r, 1) p,
p = 1 / (1 + omega^2 l^2)^2: f_z has the covariance q (d / l) K_1(d / l) at a distance d. Two linear images of it, by
transfer matrices A and B, have the cross-covariance

    k(d) = 1 / (2 pi)^2 integral A P B* exp(j omega . d) d omega,

and because the half-space looks the same in every direction, A P B* at the direction of omega is the one along x,
turned. Each entry of k along x is then one Hankel integral of order 0, 1 or 2. No grid, no period, no zero bin.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.special import j0, j1

from resonator_daemon.base.arrays import Complexes, Floats, Indices
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.skin import Prior

Field = Literal["sensor", "traction", "displacement"]

_FADED = 40.0  # omega times depth at which signals have faded to exp(-40)
_PANEL_NODES = 16
_PANEL_PHASE = 20.0  # omega times distance that one panel of Gauss-Legendre may span: error 1e-12
_KNOTS_PER_DEPTH = 20.0
_PHASES = 2_000_000  # arguments of Bessel functions at a time
_SHALLOWEST = 1.0 / 400.0
# The scalar component, then the vector's x and y: turning mixes only the latter.
_SCALAR_FIRST = {"sensor": (0, 1, 2), "traction": (2, 0, 1), "displacement": (2, 0, 1)}


@dataclass(frozen=True)
class StationaryPrior:
    """Covariances under a prior of the traction.

    Parameters
    ----------
    half_space
    prior
        Its standard deviation is not used.
    std_pascal
        Standard deviation of f_z, above 0.
    """

    half_space: HalfSpace
    prior: Prior
    std_pascal: float

    @property
    def traction_variance(self) -> Floats:
        """Of f_x, f_y, f_z, shape (3,)."""
        return self.std_pascal**2 * self.prior.powers

    def kernel(self, row: Field, row_depth_m: float, column: Field, column_depth_m: float, reach_m: float) -> "Kernel":
        """Covariance of two fields for places at most `reach_m` apart.

        ValueError where the sum of both depths is less than 1/400 of that, for which the tables would be endless.
        """
        depth_m = row_depth_m + column_depth_m
        if depth_m < _SHALLOWEST * reach_m:
            raise ValueError(f"depth {depth_m} m is too shallow for sites {reach_m} m apart, must be 1/400 of that")
        reach_m = max(reach_m, depth_m)
        omega, weights = self._quadrature(depth_m, reach_m)
        density = self.spectral_density(row, row_depth_m, column, column_depth_m, omega, 0.0)
        density *= (weights * omega / (2.0 * np.pi))[:, None, None]
        density = density[:, _SCALAR_FIRST[row], :][:, :, _SCALAR_FIRST[column]]

        distance_m = np.linspace(0.0, reach_m, 4 + int(np.ceil(reach_m * _KNOTS_PER_DEPTH / depth_m)))
        table = np.zeros((distance_m.size, 3, 3))
        for part in np.array_split(np.arange(distance_m.size), 1 + distance_m.size * omega.size // _PHASES):
            table[part] = _along_x(density, np.multiply.outer(distance_m[part], omega))
        return Kernel(CubicSpline(distance_m, table), np.argsort(_SCALAR_FIRST[row]), np.argsort(_SCALAR_FIRST[column]))

    def spectral_density(
        self,
        row: Field,
        row_depth_m: float,
        column: Field,
        column_depth_m: float,
        omega_x: ArrayLike,
        omega_y: ArrayLike,
    ) -> Complexes:
        """Return A P B* at spatial frequencies in rad/m, (..., 3, 3); see the head of this file."""
        omega_x, omega_y = np.broadcast_arrays(omega_x, omega_y)
        power = self.prior.spectrum_m2(omega_x**2 + omega_y**2)
        left, right = (
            self._response(field, omega_x, omega_y, depth_m)
            for field, depth_m in ((row, row_depth_m), (column, column_depth_m))
        )
        density: Complexes = (left * self.traction_variance) @ right.conj().swapaxes(-1, -2)
        density *= power[..., None, None]
        return density

    def _quadrature(self, depth_m: float, reach_m: float) -> tuple[Floats, Floats]:
        """Return nodes and weights from 0 to where everything has faded, fine enough for Bessel functions and p."""
        highest = _FADED / depth_m
        width = min(_PANEL_PHASE / reach_m, 2.0 / self.prior.correlation_length_m)
        edges = np.linspace(0.0, highest, 1 + int(np.ceil(highest / width)))
        nodes, weights = np.polynomial.legendre.leggauss(_PANEL_NODES)
        half = (edges[1] - edges[0]) / 2.0
        omega = (edges[:-1, None] + half * (nodes + 1.0)).ravel()
        return omega, np.tile(half * weights, edges.size - 1)

    def _response(self, field: Field, omega_x: Floats, omega_y: Floats, depth_m: float) -> Complexes:
        """Return the matrix (..., 3, 3) from the traction to a field."""
        if field == "traction":
            return np.broadcast_to(np.eye(3, dtype=np.complex128), (*omega_x.shape, 3, 3))
        return self.half_space.transfer_matrix(field, "traction", omega_x, omega_y, depth_m)


def _along_x(density: Complexes, phase: Floats) -> Floats:
    """Hankel integrals of A P B* (w, 3, 3), scalar first, for omega times distance (d, w): (d, 3, 3)."""
    order_0, order_1 = j0(phase), j1(phase)
    # By recurrence, within 2e-15: `jv` takes several times as long as both together.
    order_2 = 2.0 * np.divide(order_1, phase, out=np.full_like(phase, 0.5), where=phase > 0.0) - order_0
    mean, difference = (density[:, 1, 1] + density[:, 2, 2]).real / 2, (density[:, 1, 1] - density[:, 2, 2]).real / 2
    table = np.zeros((len(phase), 3, 3))
    table[:, 0, 0] = order_0 @ density[:, 0, 0].real
    table[:, 0, 1] = order_1 @ -density[:, 0, 1].imag
    table[:, 1, 0] = order_1 @ -density[:, 1, 0].imag
    table[:, 1, 1] = order_0 @ mean - order_2 @ difference
    table[:, 2, 2] = order_0 @ mean + order_2 @ difference
    return table


@dataclass(frozen=True)
class Kernel:
    """Covariance matrix of two fields as a function of the offset between two places."""

    _along_x: CubicSpline  # of the distance: scalar first, turned to lie along x
    _row_order: Indices
    _column_order: Indices

    def __call__(self, offset_m: Floats) -> Floats:
        """Return the matrices (..., 3, 3) for the row's place minus the column's, (..., 2)."""
        distance = np.hypot(offset_m[..., 0], offset_m[..., 1])
        safe = np.where(distance > 0.0, distance, 1.0)
        c, s = np.where(distance > 0.0, offset_m[..., 0] / safe, 1.0), offset_m[..., 1] / safe
        k = self._along_x(distance)
        along, across = k[..., 1, 1], k[..., 2, 2]
        turned = np.empty_like(k)
        turned[..., 0, 0] = k[..., 0, 0]
        turned[..., 0, 1], turned[..., 0, 2] = c * k[..., 0, 1], s * k[..., 0, 1]
        turned[..., 1, 0], turned[..., 2, 0] = c * k[..., 1, 0], s * k[..., 1, 0]
        turned[..., 1, 1] = c * c * along + s * s * across
        turned[..., 2, 2] = s * s * along + c * c * across
        turned[..., 1, 2] = turned[..., 2, 1] = c * s * (along - across)
        return turned[..., self._row_order, :][..., self._column_order]
