"""The elastic half-space: checks, choice of the transfer matrix, and its value at zero frequency.

Convention: the body fills z >= 0, z points into it. A traction f is what the object exerts on the surface, so that
f_z > 0 presses and sigma_xz, sigma_yz, sigma_zz at z = 0 are -f_x, -f_y, -f_z. Stress is positive in tension, p_n is
the mean of the three normal stresses, shear strains are tensor components, and the transform is
F(omega) = integral of f exp(-j (omega_x x + omega_y y)) dx dy. The text before eq (13) of the paper has the traction as
the stress at z = 0, so that f_z < 0 presses; eq (4) printed has p_n as a pressure.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Complexes, Floats
from resonator_daemon.estimate.elastic import transfer_matrices

Output = Literal["displacement", "strain", "stress", "p_n", "sensor", "traction"]
Input = Literal["traction", "displacement"]
ZeroRule = Literal["isolated", "periodic", "raise"]

# Sum of 1/r over a square lattice of unit spacing, its divergence removed: -4 zeta(1/2) beta(1/2).
_SQUARE_LATTICE_SUM = 3.900264920001956


@dataclass(frozen=True)
class HalfSpace:
    """Homogeneous, isotropic, linearly elastic half-space.

    Parameters
    ----------
    youngs_modulus_pascal
        Greater than 0.
    poisson_ratio
        In (-1, 0.5]; 0.5, incompressible, is exact.
    """

    youngs_modulus_pascal: float
    poisson_ratio: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if np.ndim(value):
                raise ValueError(f"{name} has shape {np.shape(value)}, must be one number")
        if not 0.0 < self.youngs_modulus_pascal < np.inf:
            raise ValueError(f"youngs_modulus_pascal is {self.youngs_modulus_pascal}, must be finite and above 0")
        if not -1.0 < self.poisson_ratio <= 0.5:
            raise ValueError(f"poisson_ratio is {self.poisson_ratio}, must be in (-1, 0.5]")

    @property
    def shear_modulus_pascal(self) -> float:
        return self.youngs_modulus_pascal / (2.0 * (1.0 + self.poisson_ratio))

    def transfer_matrix(
        self,
        output: Output,
        input: Input,
        omega_x: ArrayLike,
        omega_y: ArrayLike,
        depth_m: ArrayLike,
        *,
        zero: ZeroRule = "isolated",
        period_m: float | None = None,
    ) -> Complexes:
        """Return T with output(omega, depth) = T input(omega), Karason, Srinivasan and Annaswamy, eqs (4), (14)-(23).

        Parameters
        ----------
        output
            "displacement" (rows x, y, z), "strain" or "stress" (rows xx, yy, zz, xy, xz, yz; tensor shear), "p_n",
            "sensor" (rows 3 p_n / (2 E), eps_xz, eps_yz: dimensionless), "traction" (of "displacement", at depth 0).
        input
            "traction" or "displacement" of the surface, columns x, y, z.
        omega_x, omega_y, depth_m
            Spatial frequencies in rad/m and depths >= 0 in m, of shapes that broadcast.
        zero
            What stands at omega = 0, where a traction's matrices have no limit that all directions share.
            "isolated": the load stands alone on the plane, the mean over all directions; images a period apart then
            disturb strains and stresses by the inverse cube of the period. "periodic": the load truly repeats, and
            the strain of its mean is uniaxial; the mean displacement is counted from the mean of the surface.
            "raise": a ValueError. A displacement's matrices have true limits, which both rules give.
        period_m
            Side of the square domain; needed for "displacement" of "traction" at omega = 0 under "isolated". For
            poisson_ratio < 0.5 the field of an isolated load has, besides this constant, a part linear in x and y,
            (1 - 2 nu) / (4 mu) (-f_z x, -f_z y, f_x x + f_y y) of the mean traction f, which no period can hold.

        Returns
        -------
        array
            Complex, shape (..., rows, 3).

        Raises
        ------
        ValueError
            Unknown output, input or rule, a pair of them that has no matrix, a frequency that is not finite, a depth
            below 0 or not finite, omega = 0 under "raise" or without the period it needs.
        """
        if (output, input) not in transfer_matrices.MATRICES:
            pairs = ", ".join(f"{o} of {i}" for o, i in transfer_matrices.MATRICES)
            raise ValueError(f"output {output!r} of input {input!r} has no matrix, must be one of: {pairs}")
        if zero not in ("isolated", "periodic", "raise"):
            raise ValueError(f"zero is {zero!r}, must be 'isolated', 'periodic' or 'raise'")
        given = finite_array("omega_x", omega_x), finite_array("omega_y", omega_y), finite_array("depth_m", depth_m)
        try:
            wx, wy, depth = np.broadcast_arrays(*given)
        except ValueError:
            shapes = ", ".join(str(array.shape) for array in given)
            raise ValueError(f"omega_x, omega_y, depth_m have shapes {shapes}, which must broadcast") from None
        if depth.size and depth.min() < 0.0:
            raise ValueError(f"depth_m reaches {depth.min()}, must be at least 0")
        if output == "traction" and depth.any():
            raise ValueError(
                f"depth_m reaches {depth.max()}, must be 0 for output 'traction', which acts on the surface"
            )

        w = np.hypot(wx, wy)
        at_zero = w == 0.0
        w_safe = np.where(at_zero, 1.0, w)
        with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is looked at below
            matrix = transfer_matrices.MATRICES[output, input](
                transfer_matrices.Symbols(
                    w=w_safe,
                    c=wx / w_safe,
                    s=wy / w_safe,
                    t=np.minimum(w_safe * depth, 1e3),  # where exp(-t) is 0
                    mu=self.shear_modulus_pascal,
                    nu=self.poisson_ratio,
                )
            )
        if at_zero.any():
            if zero == "raise":
                raise ValueError("omega is 0 under zero='raise', must be above 0")
            matrix[at_zero] = self._at_zero(output, input, depth[at_zero], zero, period_m)
        if not np.isfinite(matrix).all():
            raise ValueError(
                f"omega spans {w.min()} .. {w.max()} rad/m, where {output} of {input} is beyond any number"
            )
        return matrix

    def _at_zero(
        self, output: Output, input: Input, depth_m: Floats, zero: ZeroRule, period_m: float | None
    ) -> Complexes:
        """Value at omega = 0 for depths of shape (n,): (n, rows, 3)."""
        mu, nu = self.shear_modulus_pascal, self.poisson_ratio
        if input == "displacement":
            rows = {"displacement": 3, "strain": 6, "stress": 6, "p_n": 1, "sensor": 3, "traction": 3}[output]
            rigid = np.eye(3) if output == "displacement" else np.zeros((rows, 3))
            return np.broadcast_to(rigid, (depth_m.size, rows, 3)).astype(np.complex128)
        if output == "displacement":
            return self._mean_displacement(depth_m, zero, period_m)

        # The xx, yy and zz entries of a unit f_z; a unit f_x or f_y causes nothing but its own shear.
        if zero == "isolated":
            stress_xx, stress_zz = -(0.5 + nu), -1.0
            strain_xx, strain_zz = -(1.0 - 2.0 * nu) / (4.0 * mu), -(1.0 - 2.0 * nu) / (2.0 * mu)
        else:
            stress_xx, stress_zz = -nu / (1.0 - nu), -1.0
            strain_xx, strain_zz = 0.0, -(1.0 - 2.0 * nu) / (2.0 * mu * (1.0 - nu))
        p_n = (2.0 * stress_xx + stress_zz) / 3.0
        shear = -1.0 / (2.0 * mu)
        limits = {
            "strain": _normal_and_shear(strain_xx, strain_zz, shear),
            "stress": _normal_and_shear(stress_xx, stress_zz, -1.0),
            "p_n": np.array([[0.0, 0.0, p_n]]),
            "sensor": np.array(
                [[0.0, 0.0, 3.0 * p_n / (2.0 * self.youngs_modulus_pascal)], [shear, 0.0, 0.0], [0.0, shear, 0.0]]
            ),
        }
        return np.broadcast_to(limits[output], (depth_m.size, *limits[output].shape)).astype(np.complex128)

    def _mean_displacement(self, depth_m: Floats, zero: ZeroRule, period_m: float | None) -> Complexes:
        mu, nu = self.shear_modulus_pascal, self.poisson_ratio
        if zero == "periodic":
            along = -depth_m / mu
            across = -depth_m * (1.0 - 2.0 * nu) / (2.0 * mu * (1.0 - nu))
        else:
            if period_m is None or not 0.0 < period_m < np.inf:
                raise ValueError(
                    f"period_m is {period_m}, must be finite and above 0: the displacement at omega = 0 depends on it"
                )
            g = _SQUARE_LATTICE_SUM * period_m / (4.0 * np.pi * mu)
            along = g * (2.0 - nu) - (2.5 - nu) * depth_m / (2.0 * mu)
            across = 2.0 * g * (1.0 - nu) - (1.0 - 2.0 * nu) * depth_m / (2.0 * mu)
        return (np.stack([along, along, across], axis=-1)[..., None] * np.eye(3)).astype(np.complex128)


def _normal_and_shear(xx: float, zz: float, shear: float) -> Floats:
    """Return the matrix (6, 3) of a uniform traction: xx, yy, zz of its normal part, xz and yz of its shear."""
    matrix = np.zeros((6, 3))
    matrix[:3, 2] = xx, xx, zz
    matrix[4, 0] = matrix[5, 1] = shear
    return matrix


def real_array(name: str, values: ArrayLike, shape: tuple[int, ...] | None = None) -> Floats:
    """Return a new array of doubles. ValueError for complex or non-numeric values, ragged rows, or another `shape`."""
    try:
        array = np.array(values)
    except ValueError:
        raise ValueError(f"{name} is no array: its rows differ in length") from None
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name} holds {array.dtype.name}, must hold real numbers")
    if shape is not None and array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, must be {shape}")
    return array.astype(np.float64)


def finite_array(name: str, values: ArrayLike, shape: tuple[int, ...] | None = None) -> Floats:
    """`real_array` whose values are all finite, or a ValueError that counts those that are not."""
    array = real_array(name, values, shape)
    if not np.isfinite(array).all():
        count = array.size - np.count_nonzero(np.isfinite(array))
        raise ValueError(f"{name} holds {count} values that are not finite; all must be")
    return array


def check_tolerance(tolerance: float) -> None:
    """Refuse a relative tolerance that is not above 0 and below 1."""
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"tolerance is {tolerance}, must be above 0 and below 1")
