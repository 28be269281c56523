"""Profiles of rigid objects for contact: height above each pixel of a grid, inf where there is no object.

Grids are (ny, nx) square pixels around the origin, as wide as `pitch_m`; a profile takes its value at their centres,
and is 0 where the object is lowest.
"""

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.checks import finite_array
from resonator_daemon.estimate.elastic.grid import SpectralGrid

Point = tuple[float, float]


def paraboloid(shape: tuple[int, int], pitch_m: float, radius_m: float, centre_m: Point = (0.0, 0.0)) -> Floats:
    """Paraboloid of revolution with a radius of curvature, its apex at `centre_m` (x, y); shape (ny, nx).

    ValueError for what `SpectralGrid` refuses, a radius not above 0, or values that are not finite.
    """
    return _distance_m(shape, pitch_m, radius_m, centre_m) ** 2 / (2.0 * radius_m)


def sphere(shape: tuple[int, int], pitch_m: float, radius_m: float, centre_m: Point = (0.0, 0.0)) -> Floats:
    """Lower half of a sphere; arguments and errors as of `paraboloid`."""
    r = _distance_m(shape, pitch_m, radius_m, centre_m)
    below = np.maximum(radius_m**2 - r**2, 0.0)
    # r^2 / (R + sqrt(R^2 - r^2)) is R - sqrt(R^2 - r^2), which loses digits near the apex.
    return np.where(r <= radius_m, r**2 / (radius_m + np.sqrt(below)), np.inf)


def flat_punch(shape: tuple[int, int], pitch_m: float, radius_m: float, centre_m: Point = (0.0, 0.0)) -> Floats:
    """Flat end of a round rod of `radius_m`; arguments and errors as of `paraboloid`."""
    return np.where(_distance_m(shape, pitch_m, radius_m, centre_m) <= radius_m, 0.0, np.inf)


def relief(shape: tuple[int, int], elevation_m: ArrayLike) -> Floats:
    """Face of an object in the middle of a grid of `shape`, from its elevation (rows, columns) towards the surface.

    Nothing surrounds it, so that contact may reach the edge of the face. ValueError for an elevation that is not an
    image within `shape` or not finite.
    """
    elevation = finite_array("elevation_m", elevation_m)
    if elevation.ndim != 2 or elevation.size == 0 or elevation.shape[0] > shape[0] or elevation.shape[1] > shape[1]:
        raise ValueError(f"elevation_m has shape {elevation.shape}, must be (rows, columns) of at most {shape}")
    profile = np.full(shape, np.inf)
    top, left = ((whole - part) // 2 for whole, part in zip(shape, elevation.shape, strict=True))
    profile[top : top + elevation.shape[0], left : left + elevation.shape[1]] = elevation.max() - elevation
    return profile


def _distance_m(shape: tuple[int, int], pitch_m: float, radius_m: float, centre_m: Point) -> Floats:
    """Distance of each pixel's centre from `centre_m`, after a look at all arguments."""
    SpectralGrid(shape, pitch_m)
    if not 0.0 < radius_m < np.inf:
        raise ValueError(f"radius_m is {radius_m}, must be finite and above 0")
    if not np.isfinite(centre_m).all():
        raise ValueError(f"centre_m is {centre_m}, must be finite")
    y, x = ((np.arange(count) - (count - 1) / 2.0) * pitch_m for count in shape)
    return np.asarray(np.hypot(x - centre_m[0], y[:, None] - centre_m[1]), np.float64)
