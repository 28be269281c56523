"""The half-space under one wave of traction or displacement, solved in 100 digits from the equations of elasticity.

Displacement and mean normal stress are (a + b z) exp(-w z) with eight unknown numbers. Equilibrium, the trace of
Hooke's law in compliance form (which holds at nu = 1/2) and the values at the surface are linear equations for them.
Nothing here is a transfer matrix: the columns come out of the solution.
"""

from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

mp = mpmath.mp.clone()
mp.dps = 100

Numbers = NDArray[np.object_]
PAIRS = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]  # xx, yy, zz, xy, xz, yz


class BoundaryValueProblem:
    """Fields of a unit wave; a field is an array (2, 8), its last axis the unknowns, its first the powers of z."""

    def __init__(self, wx: Any, wy: Any, nu: Any, mu: Any) -> None:
        self.w = mp.sqrt(wx * wx + wy * wy)
        self._j = (mp.mpc(0, wx), mp.mpc(0, wy))
        self._nu, self._mu = nu, mu
        unknowns = np.eye(8, dtype=int).astype(object).reshape(4, 2, 8)
        self.u, self.p_n = list(unknowns[:3]), unknowns[3]
        self.strain = [[(self.d(self.u[i], k) + self.d(self.u[k], i)) / mp.mpf(2) for k in range(3)] for i in range(3)]
        self.stress = [
            [2 * mu * self.strain[i][k] + (3 * nu / (1 + nu) * self.p_n if i == k else 0) for k in range(3)]
            for i in range(3)
        ]
        self.residual = mp.mpf(0)

    def d(self, field: Numbers, axis: int) -> Numbers:
        """Derivative along x, y or z of (a + b z) exp(-w z), exact."""
        if axis < 2:
            return self._j[axis] * field
        return np.stack([field[1] - self.w * field[0], -self.w * field[1]])

    def solve(self, source: str) -> Numbers:
        """Unknowns (8, 3) for unit inputs along x, y, z; `residual` tells how well all eleven equations are met."""
        equilibrium = [sum(self.d(self.stress[i][k], k) for k in range(3)) for i in range(3)]
        youngs_modulus = 2 * self._mu * (1 + self._nu)
        dilatation = 3 * (1 - 2 * self._nu) / youngs_modulus * self.p_n
        hooke = sum(self.strain[i][i] for i in range(3)) - dilatation
        surface = [self.u[i][0] if source == "displacement" else -self.stress[i][2][0] for i in range(3)]
        equations = mp.matrix(np.vstack([*equilibrium, hooke, surface]).tolist())
        values = mp.zeros(11, 3)
        for i in range(3):
            values[8 + i, i] = 1
        unknowns = mp.inverse(equations.H * equations) * equations.H * values
        self.residual = mp.mnorm(equations * unknowns - values, 1)
        return np.array(unknowns.tolist(), object)

    def matrices(self, source: str, z: Any) -> dict[str, Numbers]:
        """Every transfer matrix at depth z: output -> (rows, 3)."""
        unknowns = self.solve(source)
        fields = {
            "displacement": self.u,
            "strain": [self.strain[i][k] for i, k in PAIRS],
            "stress": [self.stress[i][k] for i, k in PAIRS],
            "p_n": [self.p_n],
        }
        decay = mp.exp(-self.w * z)
        found = {name: np.array([decay * (f[0] + z * f[1]) for f in rows]) @ unknowns for name, rows in fields.items()}
        scaled_p_n = 3 / (4 * self._mu * (1 + self._nu)) * found["p_n"]
        found["sensor"] = np.vstack([scaled_p_n, found["strain"][4:]])
        found["traction"] = np.array([-self.stress[i][2][0] for i in range(3)]) @ unknowns
        return found
