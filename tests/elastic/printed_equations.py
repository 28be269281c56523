"""The transfer matrices of Karason, Srinivasan and Annaswamy as printed, and the entries that must be replaced.

Written in the paper's own symbols, exact in whatever numbers are put in. Indices count from 0: rows x, y, z or xx, yy,
zz, xy, xz, yz; columns are the input's x, y, z.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from boundary_value_problem import Numbers, mp


@dataclass(frozen=True)
class Symbols:
    """One wave: omega_x, omega_y, depth, and the material."""

    x: Any
    y: Any
    z: Any
    nu: Any
    mu: Any

    @property
    def w(self) -> Any:
        return mp.sqrt(self.x * self.x + self.y * self.y)

    @property
    def k(self) -> Any:
        return 3 - 4 * self.nu


J = mp.mpc(0, 1)
HALF = mp.mpf(1) / 2
Rows = list[list[Any]]
Entries = dict[tuple[int, int], Any]


@dataclass(frozen=True)
class Equation:
    """One equation of the paper: what it claims to be, its factor, its matrix, and the entries that are corrected."""

    output: str
    source: str
    factor: Callable[[Symbols], Any]
    printed: Callable[[Symbols], Rows]
    corrections: Callable[[Symbols], Entries] = lambda _: {}

    def as_printed(self, y: Symbols) -> Numbers:
        return np.array(self.printed(y), object) * self.factor(y)

    def corrected(self, y: Symbols) -> Numbers:
        rows = np.array(self.printed(y), object)
        for entry, value in self.corrections(y).items():
            rows[entry] = value
        return rows * self.factor(y)


def eq02(v: Symbols) -> Rows:
    x, y, z, w, nu, k = v.x, v.y, v.z, v.w, v.nu, v.k
    of_u_z = J * w * x * (1 - 2 * nu) + w * z
    return [
        [J * x * (k * w - x**2 * z), -J * x**2 * y * z, w * x**2 * z],
        [-J * x * y**2 * z, J * y * (k * w - y**2 * z), w * y**2 * z],
        [-J * w * x * (1 - w * z), -J * w * y * (1 - w * z), -(w**2) * (2 * (1 - 2 * nu) + w * z)],
        [J * HALF * y * (k * w - 2 * x**2 * z), J * HALF * x * (k * w - 2 * y**2 * z), w * x * y * z],
        [-HALF * (k * w**2 + x**2 * (1 - 2 * w * z)), -HALF * x * y * (1 - 2 * z * w), of_u_z],
        [-HALF * x * y * (1 - 2 * z * w), -HALF * (k * w**2 + y**2 * (1 - 2 * w * z)), of_u_z],
    ]


def eq02_corrections(v: Symbols) -> Entries:
    bracket = 1 - 2 * v.nu + v.w * v.z
    return {(4, 2): J * v.w * v.x * bracket, (5, 2): J * v.w * v.y * bracket}


def eq04(v: Symbols) -> Rows:
    x, y, z, w = v.x, v.y, v.z, v.w
    return [
        [-J * x, -J * y, w],
        [-(w - x**2 * z), x * y * z, J * w * x * z],
        [x * y * z, -(w - y**2 * z), J * w * y * z],
    ]


def eq14(v: Symbols) -> Rows:
    x, y, z, w, nu = v.x, v.y, v.z, v.w, v.nu
    q = 2 * nu + w * z
    return [
        [2 * w**2 - x**2 * q, -x * y * q, J * x * w * (1 - 2 * nu - w * z)],
        [-x * y * q, 2 * w**2 - y**2 * q, J * y * w * (1 - 2 * nu - w * z)],
        [-J * x * w * (1 - 2 * nu + w * z), -J * y * w * (1 - 2 * nu + w * z), (2 * (1 - nu) + w * z) * w**2],
    ]


def eq15(v: Symbols) -> Rows:
    x, y, z, w, nu = v.x, v.y, v.z, v.w, v.nu
    q, m = 2 * nu + w * z, 1 - 2 * nu - w * z
    return [
        [J * x * (2 * w**2 - x**2 * q), -J * x**2 * y * q, -w * x**2 * m],
        [-J * x * y**2 * q, J * y * (2 * w**2 - y**2 * q), -w * y**2 * m],
        [-J * w**2 * x * (2 * nu - w * z), -J * w**2 * y * (2 * nu - w * z), -(w**3) * (1 - 2 * nu + w * z)],
        [J * y * (w**2 - x**2 * q), J * x * (w**2 - y**2 * q), -w * x * y * m],
        [-(w**2) * (w - x**2 * z), w**2 * x * y * z, J * w**3 * x * z],
        [w**2 * x * y * z, -(w**2) * (w - y**2 * z), J * w**3 * y * z],
    ]


def eq16(v: Symbols) -> Rows:
    x, y, z, w, nu = v.x, v.y, v.z, v.w, v.nu
    q, m = 2 * nu + w * z, 1 - 2 * nu - w * z
    return [
        [
            J * x * (2 * w**2 + 2 * nu * y**2 - x**2 * z * w),
            J * y * (2 * nu * x**2 - y**2 * z * w),
            -w * (2 * nu * y**2 + x**2 * (1 - w * z)),
        ],
        [
            J * x * (2 * nu * x**2 - w * y**2 * z),
            J * y * (2 * w**2 + 2 * nu * x**2 - y**2 * z * w),
            -w * (2 * nu * x**2 + y**2 * (1 - w * z)),
        ],
        [J * w**3 * x * z, J * w**3 * y * z, -(w**3) * (1 + z * w)],
        [J * y * (w**2 - x**2 * q), J * x * (w**2 - y**2 * q), -w * x * y * m],
        [-(w**2) * (w - x**2 * z), w**2 * x * y * z, J * w**3 * x * z],
        [w**2 * x * y * z, -(w**2) * (w - y**2 * z), J * w**3 * y * z],
    ]


def eq18(v: Symbols) -> Rows:
    x, y, w, nu = v.x, v.y, v.w, v.nu
    return [
        [2 * (w**2 - nu * x**2), -2 * nu * x * y, J * (1 - 2 * nu) * x * w],
        [-2 * nu * x * y, 2 * (w**2 - nu * y**2), J * (1 - 2 * nu) * y * w],
        [-J * (1 - 2 * nu) * x * w, -J * (1 - 2 * nu) * y * w, 2 * (1 - nu) * w**2],
    ]


def eq19(v: Symbols) -> Rows:
    x, y, w, nu, k = v.x, v.y, v.w, v.nu, v.k
    return [
        [w**2 * k + x**2, x * y, 2 * J * (1 - 2 * nu) * x * w],
        [x * y, w**2 * k + y**2, 2 * J * (1 - 2 * nu) * y * w],
        [2 * J * (1 - 2 * nu) * x * w, 2 * J * (1 - 2 * nu) * y * w, 4 * (1 - nu) * w**2],
    ]


def eq19_corrections(v: Symbols) -> Entries:
    return {(0, 2): -2 * J * (1 - 2 * v.nu) * v.x * v.w, (1, 2): -2 * J * (1 - 2 * v.nu) * v.y * v.w}


def eq20(v: Symbols) -> Rows:
    x, y, z, w, k = v.x, v.y, v.z, v.w, v.k
    return [
        [k * w - x**2 * z, -x * y * z, -J * x * w * z],
        [-x * y * z, k * w - y**2 * z, -J * y * w * z],
        [-J * x * w * z, -J * y * w * z, k * w + w**2 * z],
    ]


def printed_shear_rows(v: Symbols) -> Rows:
    """Rows xy, xz, yz, the same in (21) and (22)."""
    x, y, z, w, nu, k = v.x, v.y, v.z, v.w, v.nu, v.k
    return [
        [HALF * y * k * w - 2 * x**2 * z, HALF * x * k * w - 2 * y**2 * z, w * x * y * z],
        [-HALF * k * w**2 + x**2 * (1 - 2 * w * z), -HALF * x * y * (1 - 2 * w * z), J * w * x * (1 - 2 * nu) + w * z],
        [-HALF * x * y * (1 - 2 * w * z), -HALF * k * w**2 + y**2 * (1 - 2 * w * z), J * w * y * (1 - 2 * nu) + w * z],
    ]


def shear_corrections(v: Symbols) -> Entries:
    x, y, z, w, k = v.x, v.y, v.z, v.w, v.k
    return {
        **eq02_corrections(v),
        (3, 0): J * HALF * y * (k * w - 2 * x**2 * z),
        (3, 1): J * HALF * x * (k * w - 2 * y**2 * z),
        (4, 0): -HALF * (k * w**2 + x**2 * (1 - 2 * w * z)),
        (5, 1): -HALF * (k * w**2 + y**2 * (1 - 2 * w * z)),
    }


def eq21(v: Symbols) -> Rows:
    x, y, z, w, nu, k = v.x, v.y, v.z, v.w, v.nu, v.k
    return [
        [J * x * k * w - x**2 * z, -J * x**2 * y * z, w * x**2 * z],
        [-J * x * y**2 * z, J * y * k * w - y**2 * z, w * y**2 * z],
        [-J * w * x * (1 - w * z), -J * w * y * (1 - w * z), -(w**2) * (2 * (1 - 2 * nu) + w * z)],
        *printed_shear_rows(v),
    ]


def eq21_corrections(v: Symbols) -> Entries:
    return {
        **shear_corrections(v),
        (0, 0): J * v.x * (v.k * v.w - v.x**2 * v.z),
        (1, 1): J * v.y * (v.k * v.w - v.y**2 * v.z),
    }


def eq22(v: Symbols) -> Rows:
    x, y, z, w, nu = v.x, v.y, v.z, v.w, v.nu
    return [
        [J * x * (3 - 2 * nu) * w - x**2 * z, J * y * (2 * nu * w - x**2 * z), -w * (2 * nu * w - x**2 * z)],
        [J * x * (2 * nu * w - y**2 * z), J * y * (3 - 2 * nu) * w - y**2 * z, -w * (2 * nu * w - y**2 * z)],
        [-J * w * x * (1 - 2 * nu - w * z), -J * w * y * (1 - 2 * nu - w * z), -(w**2) * (2 * (1 - nu) + w * z)],
        *printed_shear_rows(v),
    ]


def eq22_corrections(v: Symbols) -> Entries:
    return {
        **shear_corrections(v),
        (0, 0): J * v.x * ((3 - 2 * v.nu) * v.w - v.x**2 * v.z),
        (1, 1): J * v.y * ((3 - 2 * v.nu) * v.w - v.y**2 * v.z),
    }


def per_traction(v: Symbols) -> Any:
    return mp.exp(-v.z * v.w) / (2 * v.mu * v.w**3)


def per_displacement(v: Symbols) -> Any:
    return mp.exp(-v.z * v.w) / (v.k * v.w)


def sensor_factor(v: Symbols) -> Any:
    youngs_modulus = 2 * v.mu * (1 + v.nu)
    return (1 + v.nu) * mp.exp(-v.z * v.w) / (youngs_modulus * v.w)


def two_thirds_e(v: Symbols) -> Any:
    return 2 * (2 * v.mu * (1 + v.nu)) / 3 * mp.exp(-v.z * v.w)


EQUATIONS = {
    "eq02": Equation("strain", "displacement", per_displacement, eq02, eq02_corrections),
    "eq04": Equation(
        "sensor", "traction", sensor_factor, eq04, lambda v: {(0, 0): J * v.x, (0, 1): J * v.y, (0, 2): -v.w}
    ),
    "eq14": Equation("displacement", "traction", per_traction, eq14),
    "eq15": Equation("strain", "traction", per_traction, eq15),
    "eq16": Equation(
        "stress",
        "traction",
        lambda v: mp.exp(-v.z * v.w) / v.w**3,
        eq16,
        lambda v: {(0, 1): J * v.y * (2 * v.nu * v.y**2 - v.x**2 * v.z * v.w)},
    ),
    "eq17": Equation(
        "p_n", "traction", lambda v: two_thirds_e(v) / (2 * v.mu * v.w), lambda v: [[J * v.x, J * v.y, -v.w]]
    ),
    "eq18": Equation("displacement", "traction", lambda v: 1 / (2 * v.mu * v.w**3), eq18),
    "eq19": Equation("traction", "displacement", lambda v: v.mu / (v.k * v.w), eq19, eq19_corrections),
    "eq20": Equation("displacement", "displacement", per_displacement, eq20),
    "eq21": Equation("strain", "displacement", per_displacement, eq21, eq21_corrections),
    "eq22": Equation("stress", "displacement", lambda v: 2 * v.mu * per_displacement(v), eq22, eq22_corrections),
    "eq23": Equation(
        "p_n",
        "displacement",
        lambda v: two_thirds_e(v) / v.k,
        lambda v: [[J * v.x, J * v.y, v.w]],
        lambda v: {(0, 2): -v.w},
    ),
}
