"""Transfer matrices of Karason, Srinivasan and Annaswamy, eqs (4) and (14)-(23), for omega > 0, misprints corrected.

"Encoding and Decoding of Static Information in Tactile Sensing Systems". Each function names its equation and, where
the print is wrong, the entries that differ; docs/research/reproduction.md has both forms. All are finite at nu = 1/2:
stresses are written out, never formed from the strains by Hooke's law, whose Lame constant is infinite there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Complexes, Floats

Entry = NDArray[np.inexact[Any]] | complex


@dataclass(frozen=True)
class Symbols:
    """What the entries are written in; arrays of one shape."""

    w: Floats  # modulus of omega, rad/m, above 0
    c: Floats  # omega_x / w
    s: Floats  # omega_y / w
    t: Floats  # w times depth
    mu: float  # shear modulus, Pa
    nu: float

    @property
    def e(self) -> Floats:
        return np.exp(-self.t)

    @property
    def k(self) -> float:
        return 3.0 - 4.0 * self.nu


def _matrix(factor: Floats | float, rows: Sequence[Sequence[Entry]]) -> Complexes:
    """Scaled matrix of shape (..., rows, 3) from entries that broadcast."""
    entries = np.broadcast_arrays(factor, *(entry for row in rows for entry in row))
    stacked = np.stack(entries[1:], axis=-1) * entries[0][..., None]
    return np.asarray(stacked.reshape(*stacked.shape[:-1], len(rows), 3), np.complex128)


def displacement_of_traction(y: Symbols) -> Complexes:
    """(14); at depth 0 this is (18)."""
    c, s, t, nu = y.c, y.s, y.t, y.nu
    q = 2 * nu + t
    return _matrix(
        y.e / (2 * y.mu * y.w),
        [
            [2 - c * c * q, -c * s * q, 1j * c * (1 - 2 * nu - t)],
            [-c * s * q, 2 - s * s * q, 1j * s * (1 - 2 * nu - t)],
            [-1j * c * (1 - 2 * nu + t), -1j * s * (1 - 2 * nu + t), 2 * (1 - nu) + t],
        ],
    )


def strain_of_traction(y: Symbols) -> Complexes:
    """(15)."""
    c, s, t, nu = y.c, y.s, y.t, y.nu
    q = 2 * nu + t
    m = 1 - 2 * nu - t
    return _matrix(
        y.e / (2 * y.mu),
        [
            [1j * c * (2 - c * c * q), -1j * c * c * s * q, -c * c * m],
            [-1j * c * s * s * q, 1j * s * (2 - s * s * q), -s * s * m],
            [-1j * c * (2 * nu - t), -1j * s * (2 * nu - t), -(1 - 2 * nu + t)],
            [1j * s * (1 - c * c * q), 1j * c * (1 - s * s * q), -c * s * m],
            [-(1 - c * c * t), c * s * t, 1j * c * t],
            [c * s * t, -(1 - s * s * t), 1j * s * t],
        ],
    )


def stress_of_traction(y: Symbols) -> Complexes:
    """(16), corrected in [xx, f_y]."""
    c, s, t, nu = y.c, y.s, y.t, y.nu
    q = 2 * nu + t
    m = 1 - 2 * nu - t
    cc, ss = c * c, s * s
    return _matrix(
        y.e,
        [
            [1j * c * (2 + 2 * nu * ss - cc * t), 1j * s * (2 * nu * ss - cc * t), -(2 * nu * ss + cc * (1 - t))],
            [1j * c * (2 * nu * cc - ss * t), 1j * s * (2 + 2 * nu * cc - ss * t), -(2 * nu * cc + ss * (1 - t))],
            [1j * c * t, 1j * s * t, -(1 + t)],
            [1j * s * (1 - cc * q), 1j * c * (1 - ss * q), -c * s * m],
            [-(1 - cc * t), c * s * t, 1j * c * t],
            [c * s * t, -(1 - ss * t), 1j * s * t],
        ],
    )


def p_n_of_traction(y: Symbols) -> Complexes:
    """(17)."""
    return _matrix(2 * (1 + y.nu) / 3 * y.e, [[1j * y.c, 1j * y.s, -1]])


def sensor_of_traction(y: Symbols) -> Complexes:
    """(4), corrected in the sign of its first row, which printed is a pressure; agrees with (15) and (17)."""
    c, s, t = y.c, y.s, y.t
    return _matrix(
        y.e / (2 * y.mu),
        [[1j * c, 1j * s, -1], [-(1 - c * c * t), c * s * t, 1j * c * t], [c * s * t, -(1 - s * s * t), 1j * s * t]],
    )


def traction_of_displacement(y: Symbols) -> Complexes:
    """(19), corrected in the signs of [f_x, u_z] and [f_y, u_z]: the matrix is Hermitian."""
    c, s, nu, k = y.c, y.s, y.nu, y.k
    return _matrix(
        y.mu * y.w / k,
        [
            [k + c * c, c * s, -2j * (1 - 2 * nu) * c],
            [c * s, k + s * s, -2j * (1 - 2 * nu) * s],
            [2j * (1 - 2 * nu) * c, 2j * (1 - 2 * nu) * s, 4 * (1 - nu)],
        ],
    )


def displacement_of_displacement(y: Symbols) -> Complexes:
    """(20)."""
    c, s, t, k = y.c, y.s, y.t, y.k
    return _matrix(
        y.e / k,
        [
            [k - c * c * t, -c * s * t, -1j * c * t],
            [-c * s * t, k - s * s * t, -1j * s * t],
            [-1j * c * t, -1j * s * t, k + t],
        ],
    )


def strain_of_displacement(y: Symbols) -> Complexes:
    """(21), corrected in the brackets of [xx, u_x], [yy, u_y] and of rows xy (j, too), xz, yz.

    (2) is the same matrix, corrected in [xz, u_z] (brackets) and [yz, u_z] (brackets, omega_y for omega_x).
    """
    c, s, t, nu, k = y.c, y.s, y.t, y.nu, y.k
    cc, ss = c * c, s * s
    return _matrix(
        y.e * y.w / k,
        [
            [1j * c * (k - cc * t), -1j * cc * s * t, cc * t],
            [-1j * c * ss * t, 1j * s * (k - ss * t), ss * t],
            [-1j * c * (1 - t), -1j * s * (1 - t), -(2 * (1 - 2 * nu) + t)],
            *_shear_strain_of_displacement(y),
        ],
    )


def stress_of_displacement(y: Symbols) -> Complexes:
    """(22), corrected in the brackets of [xx, u_x], [yy, u_y] and of rows xy (j, too), xz, yz."""
    c, s, t, nu, k = y.c, y.s, y.t, y.nu, y.k
    cc, ss = c * c, s * s
    return _matrix(
        2 * y.mu * y.e * y.w / k,
        [
            [1j * c * (3 - 2 * nu - cc * t), 1j * s * (2 * nu - cc * t), -(2 * nu - cc * t)],
            [1j * c * (2 * nu - ss * t), 1j * s * (3 - 2 * nu - ss * t), -(2 * nu - ss * t)],
            [-1j * c * (1 - 2 * nu - t), -1j * s * (1 - 2 * nu - t), -(2 * (1 - nu) + t)],
            *_shear_strain_of_displacement(y),
        ],
    )


def p_n_of_displacement(y: Symbols) -> Complexes:
    """(23), corrected in the sign of [u_z]."""
    return _matrix(4 * y.mu * (1 + y.nu) / (3 * y.k) * y.w * y.e, [[1j * y.c, 1j * y.s, -1]])


def sensor_of_displacement(y: Symbols) -> Complexes:
    """3 / (2 E) times (23), then the rows xz and yz of (21)."""
    return _matrix(y.e * y.w / y.k, [[1j * y.c, 1j * y.s, -1], *_shear_strain_of_displacement(y)[1:]])


def _shear_strain_of_displacement(y: Symbols) -> list[list[Entry]]:
    """Return the rows xy, xz, yz of (21) without the factor; (22) has the same ones, times 2 mu."""
    c, s, t, nu, k = y.c, y.s, y.t, y.nu, y.k
    cc, ss = c * c, s * s
    return [
        [0.5j * s * (k - 2 * cc * t), 0.5j * c * (k - 2 * ss * t), c * s * t],
        [-0.5 * (k + cc * (1 - 2 * t)), -0.5 * c * s * (1 - 2 * t), 1j * c * (1 - 2 * nu + t)],
        [-0.5 * c * s * (1 - 2 * t), -0.5 * (k + ss * (1 - 2 * t)), 1j * s * (1 - 2 * nu + t)],
    ]


MATRICES: dict[tuple[str, str], Callable[[Symbols], Complexes]] = {
    ("displacement", "traction"): displacement_of_traction,
    ("strain", "traction"): strain_of_traction,
    ("stress", "traction"): stress_of_traction,
    ("p_n", "traction"): p_n_of_traction,
    ("sensor", "traction"): sensor_of_traction,
    ("traction", "displacement"): traction_of_displacement,
    ("displacement", "displacement"): displacement_of_displacement,
    ("strain", "displacement"): strain_of_displacement,
    ("stress", "displacement"): stress_of_displacement,
    ("p_n", "displacement"): p_n_of_displacement,
    ("sensor", "displacement"): sensor_of_displacement,
}
