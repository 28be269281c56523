"""Force and moment of a contact with standard errors, from the least-squares traction on its support.

Bounds would bias the sums, and a linear map without a support adds weak opposite load around the contact.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.decoding.contact_physics.support_problem import SupportProblem

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Of forces x, y, z and moments x, y, z; both to fit closed-form contacts.
_STD_FACTOR = np.array([1.2, 1.2, 1.0, 1.0, 1.0, 1.2])  # of the posterior's: contacts are not drawn from the prior
_PIXEL_ERROR = np.array([3e-4, 3e-4, 2e-4, 2e-4, 2e-4, 3e-4])  # of the force: traction is not even over each pixel


@dataclass(frozen=True)
class NetLoad:
    """Components x, y, z; each (3,)."""

    force_newton: Floats
    force_std_newton: Floats
    moment_newton_m: Floats
    moment_std_newton_m: Floats


class LoadSums:
    """How the right sides of a problem add up to the load on some of its pixels; as good for any frame as the problem.

    Parameters
    ----------
    problem
        Of n pixels.
    chosen
        Pixels to sum over, (n,).
    arms_m
        From the point that moments refer to, to each pixel, (n, 2).
    area_m2
        Of a pixel.
    """

    def __init__(self, problem: SupportProblem, chosen: Mask, arms_m: Floats, area_m2: float) -> None:
        sums = (_functionals(arms_m, chosen) * area_m2).reshape(6, -1)
        unit = np.abs(sums).max(axis=1, keepdims=True)
        self._answers = unit * problem.solutions(sums / unit)
        power = np.einsum("sp,sp->s", sums, self._answers)
        self._std = _STD_FACTOR * np.sqrt(problem.std_pascal * np.maximum(power, 0.0))
        self._reach_m = float(np.sqrt(area_m2 * np.count_nonzero(chosen) / np.pi))

    def load(self, right_side: Singles, noise_std: float) -> NetLoad:
        """Of a frame; `noise_std` over that of the problem."""
        values = self._answers @ right_side
        by_pixels = _PIXEL_ERROR * np.linalg.norm(values[:3]) * np.repeat([1.0, self._reach_m], 3)
        std = np.hypot(self._std * noise_std, by_pixels)
        return NetLoad(values[:3], std[:3], values[3:], std[3:])


def _functionals(arms_m: Floats, chosen: Mask) -> Floats:
    """Sum forces x, y, z and moments x, y, z of unit areas of traction, (6, 3, n)."""
    x, y = arms_m.T
    sums = np.zeros((6, 3, x.size))
    sums[:3] = np.eye(3)[:, :, None]
    sums[3, 2], sums[4, 2] = y, -x
    sums[5, 0], sums[5, 1] = -y, x
    return sums * chosen
