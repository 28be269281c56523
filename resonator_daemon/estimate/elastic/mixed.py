"""Mixed conditions: at every point of the surface, three of its six quantities are known.

They are the same three all over a periodic surface, or differ from region to region.
"""

from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from resonator_daemon.base.arrays import Complexes, Floats
from resonator_daemon.estimate.elastic.constrained import Prescribed, minimise
from resonator_daemon.estimate.elastic.grid import SpectralGrid, window_around
from resonator_daemon.estimate.elastic.half_space import HalfSpace, Output, ZeroRule, finite_array, real_array
from resonator_daemon.estimate.elastic.influence import RoughStiffness, SurfaceCompliance, X, Y, Z

Quantity = Literal["u_x", "u_y", "u_z", "f_x", "f_y", "f_z"]
_QUANTITIES: tuple[Quantity, ...] = ("u_x", "u_y", "u_z", "f_x", "f_y", "f_z")


@dataclass(frozen=True)
class MixedBoundary:
    """Half-space of which three surface quantities are known everywhere, the paper's cases 1 and 2 (section 2.3).

    The known ones are phi = F [u0; f], the rows of F unit vectors, so that f = (F [T_u0f; I])^-1 phi at each frequency.
    That inverse exists where phi holds one of u_i and f_i for each axis i, because T_u0f is Hermitian and positive.
    Where an axis is named twice and another not at all, it fails at least at omega = 0 and along a line through it,
    although the paper has it that any three will do; such a mix is refused.

    Parameters
    ----------
    half_space
    grid
        Samples of the surface, which repeats at its sides.
    known
        For each axis one of "u_x", "u_y", "u_z" (m) and "f_x", "f_y", "f_z" (Pa), in any order.
    zero
        Kind of load. "periodic": the load repeats for ever, and no displacement holds a mean traction up: where
        u_i is known, its mean is as given and the mean of f_i is 0; where f_i is known, displacements are counted from
        the mean of u_i on the surface. "isolated": the load stands alone, so that the mean of u_i, counted from
        infinity, and the mean of f_i give each other, as in `HalfSpace.transfer_matrix`; for poisson_ratio < 0.5
        without the part linear in x and y that it describes.

    Raises
    ------
    ValueError
        What `SpectralGrid.transfer_matrix` refuses, and another choice of known quantities.
    """

    half_space: HalfSpace
    grid: SpectralGrid
    known: tuple[Quantity, Quantity, Quantity]
    _: KW_ONLY
    zero: ZeroRule

    def __post_init__(self) -> None:
        if not set(self.known) <= set(_QUANTITIES) or sorted(name[2] for name in self.known) != ["x", "y", "z"]:
            raise ValueError(
                f"known is {', '.join(self.known)}, must be one of u_i and f_i for each axis i: no other three "
                "determine the surface"
            )

    def transfer_matrix(self, output: Output, depth_m: float) -> Complexes:
        """Return the matrix from the known quantities, in their order, to `output`, shape (ny, nx // 2 + 1, rows, 3).

        Outputs and errors are those of `HalfSpace.transfer_matrix`; "traction" too is an output, at depth 0.
        """
        if output == "traction":
            if depth_m != 0.0:
                raise ValueError(f"depth_m is {depth_m}, must be 0 for output 'traction', which acts on the surface")
            return self._traction.copy()
        of_traction = self.grid.transfer_matrix(self.half_space, output, "traction", depth_m, zero=self.zero)
        matrix = np.asarray(of_traction @ self._traction, np.complex128)
        if output == "displacement" and self.zero == "periodic":
            for column, name in enumerate(self.known):
                if name[0] == "u":
                    matrix[0, 0, "xyz".index(name[2]), column] = 1.0  # carried along at any depth
        return matrix

    def field(self, known_values: ArrayLike, output: Output, depth_m: float = 0.0) -> Floats:
        """Field (rows, ny, nx) that goes with samples (3, ny, nx) of the known quantities, in their order.

        ValueError also for values of another shape or not finite.
        """
        values = finite_array("known_values", known_values, (3, *self.grid.shape))
        spectrum = np.einsum("yxij,jyx->iyx", self.transfer_matrix(output, depth_m), fft.rfft2(values))
        return np.asarray(fft.irfft2(spectrum, s=self.grid.shape), np.float64)

    @cached_property
    def _choice(self) -> tuple[Complexes, Floats]:
        """F [T_u0f; I] without units at each frequency, (ny, nx // 2 + 1, 3, 3), and the stiffness that scales T_u0f.

        A mean displacement of a periodic body may have any stiffness here: its traction is set to 0 afterwards.
        """
        compliance = self.grid.transfer_matrix(self.half_space, "displacement", "traction", 0.0, zero=self.zero)
        if self.zero == "periodic":
            compliance[0, 0] = np.eye(3)
        stiffness = 1.0 / np.abs(compliance).max(axis=(-2, -1))
        identity = np.broadcast_to(np.eye(3), compliance.shape)
        all_six = np.concatenate([compliance * stiffness[..., None, None], identity], axis=-2)
        return all_six[..., [_QUANTITIES.index(name) for name in self.known], :], stiffness

    @cached_property
    def _traction(self) -> Complexes:
        choice, stiffness = self._choice
        matrix = np.linalg.inv(choice)
        displacements = [column for column, name in enumerate(self.known) if name[0] == "u"]
        matrix[..., displacements] *= stiffness[..., None, None]
        if self.zero == "periodic":
            matrix[0, 0][:, displacements] = 0.0
        return np.asarray(matrix, np.complex128)


@dataclass(frozen=True)
class RegionSolution:
    """Solution of `solve_regions`."""

    traction_pascal: Floats  # (3, ny, nx)
    displacement_m: Floats  # (3, ny, nx)
    shift_m: Floats  # (3,): what was added to the known displacements; 0 where no resultant was prescribed
    residuals: tuple[float, ...]  # one an iteration, as of `minimise`; the last one is certified


def solve_regions(
    compliance: SurfaceCompliance,
    traction_pascal: ArrayLike,
    displacement_m: ArrayLike,
    *,
    resultant_newton: ArrayLike | None = None,
    tolerance: float = 1e-8,
) -> RegionSolution:
    """Find all tractions and displacements of a surface from half of them: case 3 of the paper's section 2.3.

    Parameters
    ----------
    compliance
        The body and its pixels; the surface beyond them is free of traction.
    traction_pascal, displacement_m
        What is known, (3, ny, nx) each, x, y, z: at every pixel and in each direction one of the two, NaN in the other.
    resultant_newton
        Force on the whole surface, (3,), NaN where none is prescribed. In a direction where one is, what holds the
        known displacements is free to shift as a whole until it carries the rest of the force.
    tolerance
        Of the residual of `minimise`, relative to the tractions.

    Raises
    ------
    ValueError
        Another shape; a value that is infinite; both or neither known at some pixel; a resultant in a direction in
        which no displacement is known, hence nothing to take it.
    NotConvergedError
        Where the residual stays above the tolerance.
    """
    known_traction = _checked("traction_pascal", traction_pascal, (3, *compliance.shape))
    known_displacement = _checked("displacement_m", displacement_m, (3, *compliance.shape))
    resultant = _checked("resultant_newton", np.full(3, np.nan) if resultant_newton is None else resultant_newton, (3,))
    free = np.isfinite(known_displacement)
    for axis, held, loose, total in zip("xyz", free, np.isfinite(known_traction), resultant, strict=True):
        for wrong, what in (
            (held & loose, f"both f_{axis} and u_{axis}"),
            (~held & ~loose, f"neither f_{axis} nor u_{axis}"),
        ):
            if wrong.any():
                row, column = np.argwhere(wrong)[0]
                raise ValueError(
                    f"traction_pascal and displacement_m give {what} at {np.count_nonzero(wrong)} pixels, first at "
                    f"[{row}, {column}]; must give one of them, NaN in the other"
                )
        if np.isfinite(total) and not held.any():
            raise ValueError(f"resultant_newton is {total:g} along {axis}, must be NaN where no u_{axis} is known")

    values = np.where(free, 0.0, known_traction)
    loaded = (free | (values != 0.0)).any(axis=0)
    window = (slice(None), *window_around(loaded))
    start = values[window]
    shape = (start.shape[1], start.shape[2])
    minimum = minimise(
        compliance.convolution((X, Y, Z), (X, Y, Z), shape),
        np.where(free, known_displacement, 0.0)[window],
        Prescribed(start, free[window]),
        start,
        self_compliance=compliance.of_own_load,
        precondition=RoughStiffness(shape),
        sums=resultant / compliance.pitch_m**2,
        tolerance=tolerance,
    )
    traction = np.zeros_like(values)
    traction[window] = minimum.tractions
    return RegionSolution(traction, compliance.displacement_m(traction), minimum.shift.ravel(), minimum.residuals)


def _checked(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    array = real_array(name, values, shape)
    if np.isinf(array).any():
        raise ValueError(f"{name} holds an infinite value; must be finite, or NaN where it is not known")
    return array
