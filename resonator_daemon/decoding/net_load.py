"""Force and moment of a contact with standard errors, from the least-squares traction on its support.

Bounds would bias the sums, and a linear map without a support adds weak opposite load around the contact.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.decoding.support_problem import SupportProblem

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Of forces x, y, z and moments x, y, z; both to fit closed-form contacts.
_STD_FACTOR = np.array([1.3, 1.3, 1.2, 1.2, 1.2, 1.3])  # of the posterior's: contacts are not drawn from the prior
_PIXEL_ERROR = np.array([9e-4, 9e-4, 6e-4, 6e-4, 6e-4, 9e-4])  # of the force: traction is not even over each pixel


@dataclass(frozen=True)
class NetLoad:
    """Components x, y, z; each (3,)."""

    force_newton: Floats
    force_std_newton: Floats
    moment_newton_m: Floats
    moment_std_newton_m: Floats


def net_load(
    problem: SupportProblem, rows: Singles, inside: Mask, chosen: Mask, arms_m: Floats, area_m2: float, noise_std: float
) -> NetLoad:
    """Sum the load of the chosen pixels.

    Parameters
    ----------
    problem
        Of n pixels.
    rows
        Of the frame's signals.
    inside
        Pixels that may carry load, (n,).
    chosen
        Pixels to sum over, (n,).
    arms_m
        From the point that moments refer to, to each pixel, (n, 2).
    area_m2
        Of a pixel.
    noise_std
        Of the frame over that of the problem.
    """
    start = np.zeros((3, inside.size), np.float32)
    load = problem.linear(problem.right_side(rows), inside, start).astype(np.float64)
    sums = _functionals(arms_m, chosen) * area_m2
    values = np.tensordot(sums, load, 2)
    std = np.empty(6)
    for index, functional in enumerate(sums):
        unit = np.abs(functional).max()
        scaled = (functional / unit).astype(np.float32)
        answer = problem.linear(scaled.ravel(), inside, start)
        std[index] = unit * np.sqrt(problem.std_pascal * max(float(np.sum(scaled * answer)), 0.0))
    std *= _STD_FACTOR * noise_std
    reach_m = np.sqrt(area_m2 * np.count_nonzero(chosen) / np.pi)
    std = np.hypot(std, _PIXEL_ERROR * np.linalg.norm(values[:3]) * np.repeat([1.0, reach_m], 3))
    return NetLoad(values[:3], std[:3], values[3:], std[3:])


def _functionals(arms_m: Floats, chosen: Mask) -> Floats:
    """Sum forces x, y, z and moments x, y, z of unit areas of traction, (6, 3, n)."""
    x, y = arms_m.T
    sums = np.zeros((6, 3, x.size))
    sums[:3] = np.eye(3)[:, :, None]
    sums[3, 2], sums[4, 2] = y, -x
    sums[5, 0], sums[5, 1] = -y, x
    return sums * chosen
