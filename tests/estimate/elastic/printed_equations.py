"""The transfer matrices of Karason, Srinivasan and Annaswamy as printed, and the entries that must be replaced.

Written in the paper's own symbols, exact in whatever numbers are put in. Indices count from 0: rows x, y, z or xx, yy,
zz, xy, xz, yz; columns are the input's x, y, z. Each line is a row, with commas between its entries.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from boundary_value_problem import Numbers, mp

J = mp.mpc(0, 1)


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

    def value(self, text: str) -> Any:
        """Return an expression in these symbols, h = 1 / 2, and what stands often: q, m, E."""
        own = {name: getattr(self, name) for name in ("x", "y", "z", "nu", "mu", "w", "k")}
        q, m, e = 2 * self.nu + self.w * self.z, 1 - 2 * self.nu - self.w * self.z, 2 * self.mu * (1 + self.nu)
        return eval(text, {"J": J, "h": mp.mpf(1) / 2, "q": q, "m": m, "E": e, "exp": mp.exp} | own)


@dataclass(frozen=True)
class Equation:
    """One equation of the paper: what it claims to be, its factor, its matrix, and the entries that are corrected."""

    output: str
    source: str
    factor: str
    printed: str
    replaced: dict[tuple[int, int], str] = field(default_factory=dict)

    def as_printed(self, v: Symbols) -> Numbers:
        rows = [[v.value(entry) for entry in row.split(", ")] for row in self.printed.strip().splitlines()]
        return np.array(rows, object) * v.value(self.factor)

    def corrections(self, v: Symbols) -> dict[tuple[int, int], Any]:
        return {entry: v.value(text) for entry, text in self.replaced.items()}

    def corrected(self, v: Symbols) -> Numbers:
        rows = self.as_printed(v) / v.value(self.factor)
        for entry, value in self.corrections(v).items():
            rows[entry] = value
        return rows * v.value(self.factor)


STRAIN_REPLACED = {(4, 2): "J*w*x*(1 - 2*nu + w*z)", (5, 2): "J*w*y*(1 - 2*nu + w*z)"}
SHEAR_REPLACED = STRAIN_REPLACED | {
    (3, 0): "J*h*y*(k*w - 2*x**2*z)",
    (3, 1): "J*h*x*(k*w - 2*y**2*z)",
    (4, 0): "-h*(k*w**2 + x**2*(1 - 2*w*z))",
    (5, 1): "-h*(k*w**2 + y**2*(1 - 2*w*z))",
}
PER_TRACTION = "exp(-z*w) / (2*mu*w**3)"
PER_DISPLACEMENT = "exp(-z*w) / (k*w)"
# Rows xy, xz, yz, the same in (21) and (22).
SHEAR = """
h*y*k*w - 2*x**2*z, h*x*k*w - 2*y**2*z, w*x*y*z
-h*k*w**2 + x**2*(1 - 2*w*z), -h*x*y*(1 - 2*w*z), J*w*x*(1 - 2*nu) + w*z
-h*x*y*(1 - 2*w*z), -h*k*w**2 + y**2*(1 - 2*w*z), J*w*y*(1 - 2*nu) + w*z
"""

EQ02 = """
J*x*(k*w - x**2*z), -J*x**2*y*z, w*x**2*z
-J*x*y**2*z, J*y*(k*w - y**2*z), w*y**2*z
-J*w*x*(1 - w*z), -J*w*y*(1 - w*z), -w**2*(2*(1 - 2*nu) + w*z)
J*h*y*(k*w - 2*x**2*z), J*h*x*(k*w - 2*y**2*z), w*x*y*z
-h*(k*w**2 + x**2*(1 - 2*w*z)), -h*x*y*(1 - 2*z*w), J*w*x*(1 - 2*nu) + w*z
-h*x*y*(1 - 2*z*w), -h*(k*w**2 + y**2*(1 - 2*w*z)), J*w*x*(1 - 2*nu) + w*z
"""
EQ04 = """
-J*x, -J*y, w
-(w - x**2*z), x*y*z, J*w*x*z
x*y*z, -(w - y**2*z), J*w*y*z
"""
EQ14 = """
2*w**2 - x**2*q, -x*y*q, J*x*w*m
-x*y*q, 2*w**2 - y**2*q, J*y*w*m
-J*x*w*(1 - 2*nu + w*z), -J*y*w*(1 - 2*nu + w*z), (2*(1 - nu) + w*z)*w**2
"""
EQ15 = """
J*x*(2*w**2 - x**2*q), -J*x**2*y*q, -w*x**2*m
-J*x*y**2*q, J*y*(2*w**2 - y**2*q), -w*y**2*m
-J*w**2*x*(2*nu - w*z), -J*w**2*y*(2*nu - w*z), -w**3*(1 - 2*nu + w*z)
J*y*(w**2 - x**2*q), J*x*(w**2 - y**2*q), -w*x*y*m
-w**2*(w - x**2*z), w**2*x*y*z, J*w**3*x*z
w**2*x*y*z, -w**2*(w - y**2*z), J*w**3*y*z
"""
EQ16 = """
J*x*(2*w**2 + 2*nu*y**2 - x**2*z*w), J*y*(2*nu*x**2 - y**2*z*w), -w*(2*nu*y**2 + x**2*(1 - w*z))
J*x*(2*nu*x**2 - w*y**2*z), J*y*(2*w**2 + 2*nu*x**2 - y**2*z*w), -w*(2*nu*x**2 + y**2*(1 - w*z))
J*w**3*x*z, J*w**3*y*z, -w**3*(1 + z*w)
J*y*(w**2 - x**2*q), J*x*(w**2 - y**2*q), -w*x*y*m
-w**2*(w - x**2*z), w**2*x*y*z, J*w**3*x*z
w**2*x*y*z, -w**2*(w - y**2*z), J*w**3*y*z
"""
EQ18 = """
2*(w**2 - nu*x**2), -2*nu*x*y, J*(1 - 2*nu)*x*w
-2*nu*x*y, 2*(w**2 - nu*y**2), J*(1 - 2*nu)*y*w
-J*(1 - 2*nu)*x*w, -J*(1 - 2*nu)*y*w, 2*(1 - nu)*w**2
"""
EQ19 = """
w**2*k + x**2, x*y, 2*J*(1 - 2*nu)*x*w
x*y, w**2*k + y**2, 2*J*(1 - 2*nu)*y*w
2*J*(1 - 2*nu)*x*w, 2*J*(1 - 2*nu)*y*w, 4*(1 - nu)*w**2
"""
EQ20 = """
k*w - x**2*z, -x*y*z, -J*x*w*z
-x*y*z, k*w - y**2*z, -J*y*w*z
-J*x*w*z, -J*y*w*z, k*w + w**2*z
"""
EQ21 = """
J*x*k*w - x**2*z, -J*x**2*y*z, w*x**2*z
-J*x*y**2*z, J*y*k*w - y**2*z, w*y**2*z
-J*w*x*(1 - w*z), -J*w*y*(1 - w*z), -w**2*(2*(1 - 2*nu) + w*z)"""
EQ22 = """
J*x*(3 - 2*nu)*w - x**2*z, J*y*(2*nu*w - x**2*z), -w*(2*nu*w - x**2*z)
J*x*(2*nu*w - y**2*z), J*y*(3 - 2*nu)*w - y**2*z, -w*(2*nu*w - y**2*z)
-J*w*x*(1 - 2*nu - w*z), -J*w*y*(1 - 2*nu - w*z), -w**2*(2*(1 - nu) + w*z)"""
EQ16_REPLACED = {(0, 1): "J*y*(2*nu*y**2 - x**2*z*w)"}
EQ19_REPLACED = {(0, 2): "-2*J*(1 - 2*nu)*x*w", (1, 2): "-2*J*(1 - 2*nu)*y*w"}
EQ21_REPLACED = SHEAR_REPLACED | {(0, 0): "J*x*(k*w - x**2*z)", (1, 1): "J*y*(k*w - y**2*z)"}
EQ22_REPLACED = SHEAR_REPLACED | {(0, 0): "J*x*((3 - 2*nu)*w - x**2*z)", (1, 1): "J*y*((3 - 2*nu)*w - y**2*z)"}
EQ04_REPLACED = {(0, 0): "J*x", (0, 1): "J*y", (0, 2): "-w"}
SENSOR_FACTOR = "(1 + nu)*exp(-z*w) / (E*w)"

EQUATIONS = {
    "eq02": Equation("strain", "displacement", PER_DISPLACEMENT, EQ02, STRAIN_REPLACED),
    "eq04": Equation("sensor", "traction", SENSOR_FACTOR, EQ04, EQ04_REPLACED),
    "eq14": Equation("displacement", "traction", PER_TRACTION, EQ14),
    "eq15": Equation("strain", "traction", PER_TRACTION, EQ15),
    "eq16": Equation("stress", "traction", "exp(-z*w) / w**3", EQ16, EQ16_REPLACED),
    "eq17": Equation("p_n", "traction", "2*E/3*exp(-z*w) / (2*mu*w)", "J*x, J*y, -w"),
    "eq18": Equation("displacement", "traction", "1 / (2*mu*w**3)", EQ18),
    "eq19": Equation("traction", "displacement", "mu / (k*w)", EQ19, EQ19_REPLACED),
    "eq20": Equation("displacement", "displacement", PER_DISPLACEMENT, EQ20),
    "eq21": Equation("strain", "displacement", PER_DISPLACEMENT, EQ21 + SHEAR, EQ21_REPLACED),
    "eq22": Equation("stress", "displacement", f"2*mu*{PER_DISPLACEMENT}", EQ22 + SHEAR, EQ22_REPLACED),
    "eq23": Equation("p_n", "displacement", "2*E/3*exp(-z*w) / k", "J*x, J*y, w", {(0, 2): "-w"}),
}
