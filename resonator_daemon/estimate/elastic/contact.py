"""Contact with a rigid object under Coulomb friction, through a history of loads: what acts, who sticks, who slips.

A profile is the height above each pixel of a grid, inf where there is no object. Grids are (ny, nx) square pixels
around the origin, as wide as `pitch_m`; a profile takes its value at their centres, and is 0 where the object is
lowest.
"""

from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.estimate.elastic.constrained import Face, Friction, NotConvergedError, Pushing, minimise
from resonator_daemon.estimate.elastic.grid import SpectralGrid, Window, window_around
from resonator_daemon.estimate.elastic.half_space import check_tolerance, real_array
from resonator_daemon.estimate.elastic.influence import Convolution, RoughStiffness, SurfaceCompliance, X, Y, Z

Point = tuple[float, float]

_MARGIN = 2  # pixels around the contact in which it is free to grow between two looks at the whole grid
_REMEMBERED = 5  # passes from which the next limit of friction is extrapolated
_LEAST_FRICTION = 1e-6
_STALL_PASSES = 20  # without a better residual: the passes go round in circles, or away


def paraboloid(shape: tuple[int, int], pitch_m: float, radius_m: float, centre_m: Point = (0.0, 0.0)) -> Floats:
    """Paraboloid of revolution with a radius of curvature, its apex at `centre_m` (x, y); shape (ny, nx).

    ValueError for what `SpectralGrid` refuses, a radius not above 0, or values that are not finite.
    """
    return _distance_m(shape, pitch_m, radius_m, centre_m) ** 2 / (2.0 * radius_m)


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
class FrictionState:
    """Object and surface at the end of a step, and what the next step needs of the past."""

    traction_pascal: Floats  # (3, ny, nx), by the object on the surface
    displacement_m: Floats  # (3, ny, nx), of the surface
    shift_m: Floats  # (3,), of the object: sideways since it was apart, down since 0 of its profile met the surface
    slip_m: Floats  # (2, ny, nx), of the object over the surface since they touched, 0 where they do not
    sticks: Bools  # (ny, nx): in contact, and below the limit of friction
    slips: Bools  # (ny, nx): in contact, and at the limit
    load_newton: Floats  # (3,), on the surface
    residuals: tuple[float, ...]  # one a pass, of the whole problem; the last one is certified


@dataclass(frozen=True)
class FrictionalContact:
    """A rigid object of any shape on the half-space, with Coulomb friction, loaded in steps.

    In each step, with shift s of the object, displacement u of the surface, pressure p = f_z and shear q = (f_x, f_y):

    - gap = u_z + profile - s_z >= 0, p >= 0, and one of them is 0 at each pixel (Signorini);
    - |q| <= mu p; where the object slips over the surface, by w = (s - u) - (s - u at the end of the step before)
      along x and y, q = mu p w / |w|: it drags the surface along (Coulomb, in increments; Johnson, Contact Mechanics,
      1985, section 7.2; Kalker, Three-Dimensional Elastic Bodies in Rolling Contact, 1990).

    A pixel that lifts off loses its slip. One that touches again counts its slip from the end of the step before, so
    that where the area of contact grows, the answer depends on the length of the steps, to first order. Slopes and
    shifts are small: the profile does not move sideways over the grid. Pressure moves the surface sideways and shear
    moves it up and down wherever nu < 1/2; both are taken into account.

    Method: at a given limit of friction the problem is convex, one call of `minimise` for all three components. The
    limit, mu p, is the fixed point of passes of that kind (Panagiotopoulos 1975; Necas, Jarusek and Haslinger 1980),
    extrapolated from the last few (Anderson 1965).

    Parameters
    ----------
    compliance
        The body and its pixels.
    profile_m
        Height of the object's lower side, (ny, nx); inf where there is no object.
    friction_coefficient
        mu, 0 or at least 1e-6: less drowns in the rounding of the pressure.
    tolerance
        Of the residual: |f - nearest(f + slack / self-compliance)| / |f| over all pixels, where `slack` is -gap and w,
        and `nearest` projects onto p >= 0 and |q| <= mu f_z. It is 0 at the solution and nowhere else.

    Raises
    ------
    ValueError
        A profile of another shape than the compliance has, with nan or -inf, or without an object; a coefficient that
        is negative, between 0 and 1e-6 or not finite; a tolerance that is not above 0 and below 1.
    """

    compliance: SurfaceCompliance
    profile_m: ArrayLike
    friction_coefficient: float
    tolerance: float = 1e-8

    def __post_init__(self) -> None:
        if np.isnan(self._profile).any() or (self._profile == -np.inf).any():
            raise ValueError("profile_m holds nan or -inf, must be finite, or inf where there is no object")
        if not self._under_object.any():
            raise ValueError("profile_m is inf everywhere, must be finite where there is an object")
        mu = self.friction_coefficient
        if np.ndim(mu) or not (mu == 0.0 or _LEAST_FRICTION <= mu < np.inf):
            raise ValueError(f"friction_coefficient is {mu}, must be finite, and 0 or at least {_LEAST_FRICTION:g}")
        check_tolerance(self.tolerance)

    @property
    def apart(self) -> FrictionState:
        """State before anything touches."""
        nothing, none = np.zeros((3, *self.compliance.shape)), np.zeros(self.compliance.shape, np.bool_)
        return FrictionState(nothing, nothing, np.zeros(3), nothing[:2], none, none, np.zeros(3), ())

    def step(
        self, before: FrictionState, *, load_newton: ArrayLike = np.nan, shift_m: ArrayLike = np.nan
    ) -> FrictionState:
        """Bring the object to new loads or places.

        Parameters
        ----------
        before
            End of the step before; `apart` at the start.
        load_newton, shift_m
            Total load on the surface and shift of the object, (3,), x, y, z: in each direction one of the two, NaN in
            the other. Positive along z presses.

        Raises
        ------
        ValueError
            Another shape; both or neither given in a direction; a shear load that friction cannot hold, |Q| >= mu P,
            under which the object slides away (prescribe shifts instead); a load along z that does not press;
            contact at the border, as the height map does not show what touches beyond.
        NotConvergedError
            Where the residual stays above the tolerance.
        """
        if before.traction_pascal.shape != (3, *self.compliance.shape):
            shape = before.traction_pascal.shape[1:]
            raise ValueError(f"before is a state of {shape} pixels, must be of {self.compliance.shape}")
        load, shift = _one_of_two(load_newton, shift_m)
        if load[Z] <= 0.0:
            raise ValueError(f"load_newton is {load[Z]:g} along z, must be above 0")
        free = np.isfinite(load)
        origin = np.array([*before.shift_m[:Z], 0.0])  # slip counts from the step before, the gap from the profile
        held = np.where(free, 0.0, shift - origin).reshape(3, 1, 1)
        target = held + np.stack([*before.displacement_m[:Z], -np.where(self._under_object, self._profile, 0.0)])
        mu = self.friction_coefficient

        pressure = self._pressed(target[Z], load[Z])
        f = np.stack([*before.traction_pascal[:Z], pressure])
        touched = pressure > 0.0
        limit = mu * pressure
        extrapolation = _Extrapolation()
        uncoupled = self.compliance.half_space.poisson_ratio == 0.5  # shear does not change the pressure
        tolerance = self.tolerance / 4.0 if uncoupled else 1e-2
        residuals: list[float] = []
        while True:
            self._check_shear(load[:Z], limit)
            f, moved = self._at_limit(limit, target, load, f, window_around(touched, _MARGIN), tolerance)
            displacement = self._respond(f)
            slack = target + moved - displacement
            aim = _Limited(mu * f[Z], self._under_object).nearest(f + slack / self.compliance.of_own_load)
            residuals.append(float(np.linalg.norm(aim - f) / (np.linalg.norm(f) or 1.0)))
            best = min(residuals)
            if best <= self.tolerance:
                break
            if len(residuals) > _STALL_PASSES and best > 0.9 * min(residuals[:-_STALL_PASSES]):
                raise NotConvergedError(
                    f"residual of contact with friction stays at {best:.2g} after {len(residuals)} passes, must reach"
                    f" {self.tolerance:.2g}; smaller steps or less friction may help",
                    tuple(residuals),
                )
            touched = (f[Z] > 0.0) | (aim[Z] > 0.0)
            tolerance = max(self.tolerance / 4.0, 0.1 * best)
            limit = np.maximum(extrapolation.next(limit, mu * f[Z]), 0.0)

        touches = f[Z] > 0.0
        self._check_border(touches)
        sticks = touches & (np.hypot(*f[:Z]) < limit * (1.0 - 1e-9))
        return FrictionState(
            traction_pascal=f,
            displacement_m=displacement,
            shift_m=origin + (held + moved)[:, 0, 0],
            slip_m=np.where(touches, before.slip_m + slack[:Z], 0.0),
            sticks=sticks,
            slips=touches & ~sticks,
            load_newton=f.sum(axis=(1, 2)) * self.compliance.pitch_m**2,
            residuals=tuple(residuals),
        )

    def _pressed(self, target: Floats, load_newton: float) -> Floats:
        """Return the pressure without friction, at a load or, where that is NaN, at the place that `target` has."""
        sums, start = None, np.where(self._under_object & (target > 0.0), 1.0, 0.0)
        if np.isfinite(load_newton):
            sums = np.array([load_newton / self.compliance.pitch_m**2])
            start = np.where(self._under_object, sums / np.count_nonzero(self._under_object), 0.0)
        found = minimise(
            self.compliance.convolution((Z,), (Z,), target.shape),
            target[None],
            Pushing(self._under_object),
            start[None],
            self_compliance=self.compliance.of_own_load,
            precondition=RoughStiffness(target.shape),
            sums=sums,
            tolerance=self.tolerance / 4.0,
        )
        return np.asarray(found.tractions[0], np.float64)

    def _at_limit(
        self, limit: Floats, target: Floats, load: Floats, start: Floats, window: Window, tolerance: float
    ) -> tuple[Floats, Floats]:
        """Return tractions within a window, and shift (3, 1, 1) where loads are given, at a given limit of friction."""
        part = (slice(None), *window)
        shape = limit[window].shape
        found = minimise(
            self.compliance.convolution((X, Y, Z), (X, Y, Z), shape),
            target[part],
            _Limited(limit[window], self._under_object[window]),
            start[part],
            self_compliance=self.compliance.of_own_load,
            precondition=RoughStiffness(shape),
            sums=load / self.compliance.pitch_m**2,
            tolerance=tolerance,
        )
        f = np.zeros_like(start)
        f[part] = found.tractions
        return f, found.shift

    @cached_property
    def _profile(self) -> Floats:
        return real_array("profile_m", self.profile_m, self.compliance.shape)

    @cached_property
    def _under_object(self) -> Bools:
        return np.isfinite(self._profile)

    @cached_property
    def _respond(self) -> Convolution:
        return self.compliance.convolution((X, Y, Z), (X, Y, Z), self.compliance.shape)

    def _check_shear(self, load_newton: Floats, limit: Floats) -> None:
        shear = float(np.linalg.norm(np.nan_to_num(load_newton)))
        most = float(limit.sum()) * self.compliance.pitch_m**2
        if shear > 0.0 and shear >= most:
            raise ValueError(
                f"shear load is {shear:.6g} N, must be below friction coefficient x normal load = {most:.6g} N,"
                " or the object slides away; prescribe shift_m instead"
            )

    def _check_border(self, touches: Bools) -> None:
        if touches[[0, -1]].any() or touches[:, [0, -1]].any():
            raise ValueError(
                f"contact touches the border of the height map, shape {touches.shape}, which must enclose it: press or"
                " shear less, or give a larger map, or one with a rim of inf, no object"
            )


@dataclass(frozen=True)
class _Limited:
    """Shear of modulus at most `limit`, and pressure >= 0, 0 where there is no object."""

    limit: Floats
    under_object: Bools

    def nearest(self, tractions: Floats) -> Floats:
        shear, pressure = self._parts()
        return np.concatenate([shear.nearest(tractions[:Z]), pressure.nearest(tractions[Z:])])

    def face(self, tractions: Floats, push: Floats | None) -> Face:
        shear, pressure = self._parts()
        along = shear.face(tractions[:Z], None if push is None else push[:Z])
        down = pressure.face(tractions[Z:], None if push is None else push[Z:])
        flat = np.zeros((1, *self.limit.shape))
        return Face(
            free=np.concatenate([np.broadcast_to(along.free, (2, *self.limit.shape)), down.free]),
            barred=None if along.barred is None else np.concatenate([along.barred, flat]),
            curvature=None if along.curvature is None else np.stack([along.curvature, along.curvature, flat[0]]),
        )

    def yielding(self, tractions: Floats) -> Floats:
        shear, pressure = self._parts()
        both = np.zeros((3, 3))
        both[:Z, :Z] = shear.yielding(tractions[:Z])
        both[Z:, Z:] = pressure.yielding(tractions[Z:])
        return both

    def _parts(self) -> tuple[Friction, Pushing]:
        return Friction(self.limit), Pushing(self.under_object)


class _Extrapolation:
    """Anderson's: the next guess of a fixed point from the last few guesses and what became of them."""

    def __init__(self) -> None:
        self._guesses: deque[Floats] = deque(maxlen=_REMEMBERED)
        self._results: deque[Floats] = deque(maxlen=_REMEMBERED)

    def next(self, guess: Floats, result: Floats) -> Floats:
        self._guesses.append(guess)
        self._results.append(result)
        results = np.array(self._results).reshape(len(self._results), -1)
        misses = results - np.array(self._guesses).reshape(results.shape)
        steps = misses[:-1] - misses[-1]
        shares = np.linalg.lstsq(steps.T, -misses[-1])[0]
        return np.asarray(results[-1] + shares @ (results[:-1] - results[-1]), np.float64).reshape(result.shape)


def _one_of_two(load_newton: ArrayLike, shift_m: ArrayLike) -> tuple[Floats, Floats]:
    load, shift = real_array("load_newton", load_newton), real_array("shift_m", shift_m)
    for name, given in (("load_newton", load), ("shift_m", shift)):
        if given.shape != (3,) and not (given.shape == () and np.isnan(given)):
            raise ValueError(f"{name} has shape {given.shape}, must be (3,)")
        if np.isinf(given).any():
            raise ValueError(f"{name} is {given}, must be finite, or NaN where the other one is given")
    load, shift = np.broadcast_to(load, 3), np.broadcast_to(shift, 3)
    if (np.isfinite(load) == np.isfinite(shift)).any():
        raise ValueError(f"load_newton is {load}, shift_m is {shift}: in each direction one must be given, one be NaN")
    return load, shift
