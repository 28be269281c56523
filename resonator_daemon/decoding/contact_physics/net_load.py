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

_F_Z, _M_X, _M_Y = 2, 3, 4
# Of forces x, y, z and moments x, y, z; both to fit closed-form contacts.
_STD_FACTOR = np.array([1.2, 1.2, 1.0, 1.0, 1.0, 1.2])  # of the posterior's: contacts are not drawn from the prior
_PIXEL_ERROR = np.array([3e-4, 3e-4, 2e-4, 2e-4, 2e-4, 3e-4])  # of the force: traction is not even over each pixel


@dataclass(frozen=True)
class NetLoad:
    """Components x, y, z, each (3,); the centroid, x and y, is that of the pressure."""

    force_newton: Floats
    force_std_newton: Floats
    moment_newton_m: Floats
    moment_std_newton_m: Floats
    centroid_m: Floats
    centroid_std_m: Floats


class LoadSums:
    """How the right sides of a problem add up to the load on some of its pixels; as good for any frame as the problem.

    Parameters
    ----------
    problem
        Of n pixels.
    chosen
        Pixels to sum over, at least one, (n,).
    centres_m
        Of the pixels, (n, 2).
    about_m
        What moments refer to.
    area_m2
        Of a pixel.
    """

    def __init__(
        self, problem: SupportProblem, chosen: Mask, centres_m: Floats, about_m: tuple[float, float], area_m2: float
    ) -> None:
        arms_m = centres_m - about_m
        sums = (_functionals(arms_m, chosen) * area_m2).reshape(6, -1)
        unit = np.abs(sums).max(axis=1, keepdims=True)
        unit[unit == 0.0] = 1.0  # a single pixel right there
        self._answers = unit * problem.solutions(sums / unit)
        self._covariance = problem.std_pascal * sums @ self._answers.T * np.outer(_STD_FACTOR, _STD_FACTOR)
        self._about_m = np.array(about_m)
        self._lever_m = float(np.sqrt(np.mean(np.sum(arms_m[chosen] ** 2, axis=1))))
        self._radius_m = float(np.sqrt(area_m2 * np.count_nonzero(chosen) / np.pi))

    def load(self, right_side: Singles, noise_std: float) -> NetLoad:
        """Of a frame; `noise_std` over that of the problem."""
        values = self._answers @ right_side
        covariance = self._covariance * noise_std**2
        by_pixels = _PIXEL_ERROR * np.linalg.norm(values[:3]) * np.repeat([1.0, self._lever_m], 3)
        std = np.hypot(np.sqrt(np.maximum(np.diag(covariance), 0.0)), by_pixels)
        normal = float(values[_F_Z])
        arm_m = np.array([-values[_M_Y], values[_M_X]]) / normal
        # What a sum of f_z times the distance from the centroid scatters by, (x, y).
        away = np.zeros((2, 6))
        away[0, _M_Y], away[1, _M_X] = -1.0, 1.0
        away[:, _F_Z] = -arm_m
        variance = np.einsum("cs,st,ct->c", away, covariance, away)
        centroid_std_m = np.sqrt(np.maximum(variance, 0.0)) / abs(normal)
        centroid_std_m = np.hypot(centroid_std_m, _PIXEL_ERROR[_F_Z] * self._radius_m)
        return NetLoad(values[:3], std[:3], values[3:], std[3:], self._about_m + arm_m, centroid_std_m)


def _functionals(arms_m: Floats, chosen: Mask) -> Floats:
    """Sum forces x, y, z and moments x, y, z of unit areas of traction, (6, 3, n)."""
    x, y = arms_m.T
    sums = np.zeros((6, 3, x.size))
    sums[:3] = np.eye(3)[:, :, None]
    sums[3, 2], sums[4, 2] = y, -x
    sums[5, 0], sums[5, 1] = -y, x
    return sums * chosen
