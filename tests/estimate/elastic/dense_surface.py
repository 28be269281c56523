"""Surface displacements by tractions as full matrices: point loads summed over pixels, or waves one by one."""

from functools import cache

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats


def dense_compliance(shape: tuple[int, int], nu: float, mu: float, pitch_m: float, *, periodic: bool) -> Floats:
    """Matrix from tractions to displacements, each (3, ny, nx) flattened, in metres per pascal."""
    ny, nx = shape
    kernel = _periodic_kernel(shape, nu) if periodic else _open_kernel(shape, nu)
    y, x = (index.ravel() for index in np.indices(shape))
    lag_y, lag_x = y[:, None] - y, x[:, None] - x
    blocks = kernel[:, :, lag_y % ny, lag_x % nx] if periodic else kernel[:, :, lag_y + ny - 1, lag_x + nx - 1]
    return np.asarray(blocks.transpose(0, 2, 1, 3).reshape(3 * ny * nx, 3 * ny * nx) * (pitch_m / mu))


def _periodic_kernel(shape: tuple[int, int], nu: float) -> Floats:
    """A wave's transverse traction meets the compliance 1 / (mu w); the longitudinal and the normal one are coupled."""
    omega_y, omega_x = (2.0 * np.pi * np.fft.fftfreq(n) for n in shape)
    spectrum = np.zeros((*shape, 3, 3), complex)
    for index in np.ndindex(shape):
        wy, wx = omega_y[index[0]], omega_x[index[1]]
        if index != (0, 0):
            spectrum[index] = np.mean([_wave(x, y, nu) for x in _signs(wx) for y in _signs(wy)], axis=0)
    return np.fft.ifft2(spectrum, axes=(0, 1)).real.transpose(2, 3, 0, 1)


def _signs(omega: float) -> list[float]:
    """List it, and a Nyquist frequency with both its signs."""
    return [omega, -omega] if omega == -np.pi else [omega]


def _wave(wx: float, wy: float, nu: float) -> NDArray[np.complex128]:
    w = np.hypot(wx, wy)
    along = np.array([wx / w, wy / w, 0.0])
    inward = np.array([0.0, 0.0, 1.0])
    across = np.cross(inward, along)
    own = np.outer(along, along) + np.outer(inward, inward)
    coupling = np.outer(along, inward) - np.outer(inward, along)
    return (np.outer(across, across) + (1 - nu) * own + 0.5j * (1 - 2 * nu) * coupling) / w


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
