"""Surface displacements by tractions as full matrices: point loads summed over pixels."""

from functools import cache

import numpy as np
from numpy.polynomial.legendre import leggauss

from resonator_daemon.base.arrays import Floats


def dense_compliance(shape: tuple[int, int], nu: float, mu: float, pitch_m: float) -> Floats:
    """Matrix from tractions to displacements, each (3, ny, nx) flattened, in metres per pascal."""
    ny, nx = shape
    y, x = (index.ravel() for index in np.indices(shape))
    lag_y, lag_x = y[:, None] - y, x[:, None] - x
    blocks = _open_kernel(shape, nu)[:, :, lag_y + ny - 1, lag_x + nx - 1]
    return np.asarray(blocks.transpose(0, 2, 1, 3).reshape(3 * ny * nx, 3 * ny * nx) * (pitch_m / mu))


def _open_kernel(shape: tuple[int, int], nu: float) -> Floats:
    """Boussinesq's and Cerruti's surface displacements, Johnson, Contact Mechanics, eqs (3.19) and (3.75) at z = 0."""
    one_r, xx, xy, x, y = _pixel_integrals(shape)
    yy = one_r - xx
    slope = (1 - 2 * nu) / 2
    rows = [
        [(1 - nu) * one_r + nu * xx, nu * xy, -slope * x],
        [nu * xy, (1 - nu) * one_r + nu * yy, -slope * y],
        [slope * x, slope * y, (1 - nu) * one_r],
    ]
    return np.array(rows) / (2 * np.pi)


@cache
def _pixel_integrals(shape: tuple[int, int]) -> Floats:
    """Integrals over the unit square of 1/r, x^2/r^3, x y/r^3, x/r^2, y/r^2 at each lag, by Gauss and Legendre."""
    ny, nx = shape
    nodes, weights = leggauss(20)
    dy = (np.arange(1 - ny, ny)[:, None] + nodes / 2)[:, None, :, None]
    dx = (np.arange(1 - nx, nx)[:, None] + nodes / 2)[None, :, None, :]
    r = np.hypot(dx, dy)
    functions = [1 / r, dx**2 / r**3, dx * dy / r**3, dx / r**2, dy / r**2]
    integrals = np.array([np.einsum("yxij,i,j->yx", f, weights / 2, weights / 2) for f in functions])
    own = 4 * np.log(1 + np.sqrt(2))  # where the nodes would meet the pole; the odd ones cancel
    integrals[:, ny - 1, nx - 1] = own, own / 2, 0.0, 0.0, 0.0
    return integrals
