"""Mixed conditions on known regions: at every pixel and in each direction either the traction or the displacement."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.checks import real_array
from resonator_daemon.estimate.elastic.constrained import Prescribed, minimise
from resonator_daemon.estimate.elastic.grid import window_around
from resonator_daemon.estimate.elastic.influence import RoughStiffness, SurfaceCompliance, X, Y, Z


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
        The body and its pixels. On the infinite plane the surface beyond them is free of traction; a periodic one
        counts displacements from their mean.
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
        which no displacement is known, hence nothing to take it; displacements known all over a periodic surface in a
        direction without a resultant, hence no mean traction.
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
        if compliance.periodic and held.all() and not np.isfinite(total):
            raise ValueError(
                f"displacement_m gives u_{axis} on the whole of a periodic surface, which leaves its mean f_{axis} "
                f"open; resultant_newton must give the force along {axis}"
            )

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
    array = real_array(name, values)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, must be {shape}")
    if np.isinf(array).any():
        raise ValueError(f"{name} holds an infinite value; must be finite, or NaN where it is not known")
    return array
