"""Contact with a rigid object of any shape, without friction: profiles of objects, who touches, and with what pressure.

A profile is the height above each pixel of a grid, inf where there is no object. Grids are (ny, nx) square pixels
around the origin, as wide as `pitch_m`; a profile takes its value at their centres, and is 0 where the object is
lowest.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.estimate.elastic.constrained import NotConvergedError, Pushing, minimise
from resonator_daemon.estimate.elastic.grid import SpectralGrid, window_around
from resonator_daemon.estimate.elastic.half_space import check_tolerance, real_array
from resonator_daemon.estimate.elastic.influence import RoughStiffness, SurfaceCompliance, Z

Point = tuple[float, float]

_COARSEST = 12  # pixels a side that a coarser grid must have to pay
_COARSE_TOLERANCE = 3e-2  # about as far as the coarser grid is from the finer one
_MARGIN = 2  # pixels around a first guess of the contact that may come to touch


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


def _distance_m(shape: tuple[int, int], pitch_m: float, radius_m: float, centre_m: Point) -> Floats:
    """Distance of each pixel's centre from `centre_m`, after a check of all arguments."""
    SpectralGrid(shape, pitch_m)
    if not 0.0 < radius_m < np.inf:
        raise ValueError(f"radius_m is {radius_m}, must be finite and above 0")
    if not np.isfinite(centre_m).all():
        raise ValueError(f"centre_m is {centre_m}, must be finite")
    y, x = ((np.arange(count) - (count - 1) / 2.0) * pitch_m for count in shape)
    return np.asarray(np.hypot(x - centre_m[0], y[:, None] - centre_m[1]), np.float64)


@dataclass(frozen=True)
class NormalContact:
    """Pressure under a rigid object pressed into the surface."""

    compliance: SurfaceCompliance
    profile_m: Floats  # (ny, nx)
    pressure_pascal: Floats  # (ny, nx), at least 0
    approach_m: float  # of the object, from where height 0 of its profile is level with the unloaded surface
    residuals: tuple[float, ...]  # one an iteration on this grid; the last is certified

    @property
    def load_newton(self) -> float:
        return float(self.pressure_pascal.sum()) * self.compliance.pitch_m**2

    @property
    def touches(self) -> Bools:
        """Pixels under pressure, (ny, nx)."""
        return self.pressure_pascal > 0.0

    @property
    def area_m2(self) -> float:
        return int(np.count_nonzero(self.touches)) * self.compliance.pitch_m**2

    @cached_property
    def gap_m(self) -> Floats:
        """Gap between surface and object, (ny, nx): 0 within the residual where they touch, inf below no object."""
        depth_by_pressure = self.compliance.convolution((Z,), (Z,), self.compliance.shape)
        depth_m = depth_by_pressure(self.pressure_pascal[None])[0]
        return np.asarray(depth_m + self.profile_m - self.approach_m, np.float64)


def press(
    compliance: SurfaceCompliance,
    profile_m: ArrayLike,
    *,
    load_newton: float | None = None,
    approach_m: float | None = None,
    tolerance: float = 1e-8,
) -> NormalContact:
    """Press a rigid object into the surface, without friction, until it carries a load or has come a given way.

    The pressure p >= 0 leaves a gap u_z(p) + profile - approach >= 0 that is 0 wherever p > 0 (Signorini), which makes
    p the minimum of the complementary energy (Kalker, Three-Dimensional Elastic Bodies in Rolling Contact, 1990).
    `minimise` finds it on grids of ever halved pitch, each from the contact of the last and among the pixels near it.

    The last residual is |p - max(p - gap / c, 0)| / |p| over the whole grid, c being the compliance of a pixel to its
    own load. It is taken where the profile lies below the approach alone: pressure raises the surface nowhere, so that
    elsewhere the gap is open.

    Parameters
    ----------
    compliance
        The surface; of its coefficients those of normal displacement by pressure count.
    profile_m
        Height of the object above each pixel, shape (ny, nx); inf where there is no object.
    load_newton, approach_m
        One of the two. Load: above 0. Approach: how far the object comes from where height 0 is level with the unloaded
        surface; where it then touches nothing, the answer is a pressure of 0.
    tolerance
        Residual to reach, above 0 and below 1.

    Raises
    ------
    ValueError
        What differs from the above; contact at the border, as the height map does not show what touches beyond.
    NotConvergedError
        A tolerance out of reach.
    """
    profile = real_array("profile_m", profile_m)
    check_object(compliance, profile)
    _check_request(load_newton, approach_m, tolerance)
    try:
        contact = _press(compliance, profile, load_newton, approach_m, tolerance)
    except NotConvergedError as error:
        raise NotConvergedError(f"contact: {error}; a greater tolerance helps", error.residuals) from error
    touches = contact.touches
    if touches[[0, -1]].any() or touches[:, [0, -1]].any():
        raise ValueError(
            f"load_newton is {contact.load_newton:.6g} at approach_m {contact.approach_m:.6g}, where contact touches "
            f"the border of the height map, shape {profile.shape}, which must enclose it: press less, or give a larger "
            "map, or one with a rim of inf, no object"
        )
    return contact


def check_object(compliance: SurfaceCompliance, profile: Floats) -> None:
    if profile.shape != compliance.shape:
        raise ValueError(f"profile_m has shape {profile.shape}, must be {compliance.shape}")
    if np.isnan(profile).any() or (profile == -np.inf).any():
        raise ValueError("profile_m holds nan or -inf, must be finite, or inf where there is no object")
    if not np.isfinite(profile).any():
        raise ValueError("profile_m is inf everywhere, must be finite where there is an object")


def _check_request(load: float | None, approach: float | None, tolerance: float) -> None:
    for name, value in (("load_newton", load), ("approach_m", approach)):
        if value is not None and np.ndim(value):
            raise ValueError(f"{name} has shape {np.shape(value)}, must be one number")
    if (load is None) == (approach is None):
        raise ValueError(f"load_newton is {load} and approach_m is {approach}, must be just one of the two")
    if load is not None and not 0.0 < load < np.inf:
        raise ValueError(f"load_newton is {load}, must be finite and above 0")
    if approach is not None and not -np.inf < approach < np.inf:
        raise ValueError(f"approach_m is {approach}, must be finite")
    check_tolerance(tolerance)


def _press(
    compliance: SurfaceCompliance,
    profile: Floats,
    load: float | None,
    approach: float | None,
    tolerance: float,
) -> NormalContact:
    pressure = np.zeros(profile.shape)
    if approach is not None and approach <= profile.min():
        return NormalContact(compliance, profile, pressure, approach, (0.0,))
    there = np.isfinite(profile)
    start = np.where(there, _of_coarser_grid(compliance, profile, load, approach), 0.0)
    if not start.any():
        start = np.where(there if approach is None else profile < approach, 1.0, 0.0)
    sums = None
    if load is not None:
        sums = np.array([load / compliance.pitch_m**2])
        start = start * (sums / start.sum())
    target = np.where(there, -profile, 0.0) + (0.0 if approach is None else approach)
    window = window_around(start > 0.0, _MARGIN)
    residuals: tuple[float, ...] = ()
    while True:
        shape = target[window].shape
        found = minimise(
            compliance.convolution((Z,), (Z,), shape),
            target[None, *window],
            Pushing(there[window]),
            start[None, *window],
            self_compliance=compliance.of_own_load,
            precondition=RoughStiffness(shape),
            sums=sums,
            tolerance=tolerance,
        )
        pressure[window] = found.tractions[0]
        residuals += found.residuals
        came = float(found.shift[0, 0, 0]) if approach is None else approach
        may_touch = profile < came
        may_touch[window] = True
        wider = window_around(may_touch)
        if wider == window:
            return NormalContact(compliance, profile, pressure, came, residuals)
        start, window = pressure, wider


def _of_coarser_grid(
    compliance: SurfaceCompliance, profile: Floats, load: float | None, approach: float | None
) -> Floats:
    """Pressure found on a grid of twice the pitch; 0 where that would not pay."""
    if min(profile.shape) < 2 * _COARSEST:
        return np.zeros(profile.shape)
    padded = np.pad(profile, [(0, count % 2) for count in profile.shape], constant_values=np.inf)
    blocks = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
    there = np.isfinite(blocks)
    count = there.sum(axis=(1, 3))
    heights = np.where(there, blocks, 0.0).sum(axis=(1, 3)) / np.maximum(count, 1)
    heights[count == 0] = np.inf
    coarse = SurfaceCompliance(compliance.half_space, heights.shape, 2.0 * compliance.pitch_m)
    contact = _press(coarse, heights, load, approach, _COARSE_TOLERANCE)
    return contact.pressure_pascal.repeat(2, 0).repeat(2, 1)[: profile.shape[0], : profile.shape[1]]
