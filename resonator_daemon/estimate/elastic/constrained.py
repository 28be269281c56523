"""Tractions under a condition at every pixel: one method for known regions, normal contact and friction.

It finds the tractions f of a convex set that minimise  f.A f / 2 - f.b,  A symmetric and positive, among those of a
prescribed sum where there is one. At the minimum the slack  b + shift - A f  vanishes wherever f is free to move; the
shift, the multiplier of the sum, is how far the object came.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.estimate.elastic.half_space import check_tolerance

LinearMap = Callable[[Floats], Floats]

_BEYOND_NUMBERS = "tractions or displacements are too large or too small to square; choose other units"
_STALL_ITERATIONS = 100  # without a better residual: it goes round in circles, or rounding is reached


class NotConvergedError(ArithmeticError):
    """An iteration that ended above its tolerance; `residuals` holds its history."""

    def __init__(self, message: str, residuals: tuple[float, ...]) -> None:
        super().__init__(message)
        self.residuals = residuals


@dataclass(frozen=True)
class Face:
    """Directions in which tractions can move that are at their bounds and pushed outwards."""

    free: Bools  # broadcasts to (components, ny, nx)
    barred: Floats | None = None  # (components, ny, nx), unit vectors, or 0 where none is barred
    curvature: Floats | None = None  # (ny, nx): how much the bend of the bound adds to the energy's second derivative

    def restrict(self, vectors: Floats) -> Floats:
        """Project (components, ny, nx) orthogonally."""
        kept = np.where(self.free, vectors, 0.0)
        if self.barred is not None:
            kept -= self.barred * np.einsum("iyx,iyx->yx", self.barred, kept)
        return kept

    def means(self, vectors: Floats, balanced: Bools) -> Floats:
        """Constant vector, (components, 1, 1), nearest to `vectors` in these directions; 0 where not `balanced`."""
        sums = self.restrict(vectors).sum(axis=(1, 2))
        counts = np.broadcast_to(self.free, vectors.shape).sum(axis=(1, 2))
        if self.barred is None:
            means = np.where(balanced, sums / np.maximum(counts, 1), 0.0)
        else:
            open_ = np.diag(counts.astype(np.float64)) - np.einsum("iyx,jyx->ij", self.barred, self.barred)
            means = np.linalg.lstsq(open_ * np.outer(balanced, balanced), sums * balanced)[0]
        return np.asarray(means, np.float64).reshape(-1, 1, 1)

    def bend(self, direction: Floats) -> float:
        """Share of the bounds' bend in the second derivative of the energy along `direction`."""
        return 0.0 if self.curvature is None else float(np.vdot(direction, self.curvature * direction))


class Bounds(Protocol):
    """A closed convex set of tractions at every pixel."""

    def nearest(self, tractions: Floats) -> Floats:
        """Project (components, ny, nx) onto the set."""

    def face(self, tractions: Floats, push: Floats | None) -> Face:
        """Return the directions open to allowed `tractions` under `push`; None: those of tractions off bounds."""

    def yielding(self, tractions: Floats) -> Floats:
        """Differentiate the sum of `nearest` by a common offset: (components, components), positive definite."""


@dataclass(frozen=True)
class Prescribed:
    """Known tractions at some components and pixels, any at the others."""

    values: Floats
    free: Bools

    def nearest(self, tractions: Floats) -> Floats:
        return np.where(self.free, tractions, self.values)

    def face(self, tractions: Floats, push: Floats | None) -> Face:
        return Face(self.free)

    def yielding(self, tractions: Floats) -> Floats:
        return np.asarray(np.diag(np.maximum(self.free.sum(axis=(1, 2)), 1.0)), np.float64)


@dataclass(frozen=True)
class Pushing:
    """Tractions of one component >= 0, and 0 outside `allowed`."""

    allowed: Bools  # (ny, nx)

    def nearest(self, tractions: Floats) -> Floats:
        return np.where(self.allowed, np.maximum(tractions, 0.0), 0.0)

    def face(self, tractions: Floats, push: Floats | None) -> Face:
        open_ = tractions > 0.0 if push is None else (tractions > 0.0) | (push > 0.0)
        return Face(open_ & self.allowed)

    def yielding(self, tractions: Floats) -> Floats:
        return np.array([[max(np.count_nonzero((tractions > 0.0) & self.allowed), 1)]])


@dataclass(frozen=True)
class Friction:
    """Tangential tractions whose modulus is at most `limit`."""

    limit: Floats  # (ny, nx)

    def nearest(self, tractions: Floats) -> Floats:
        modulus = np.hypot(*tractions)
        share = np.divide(self.limit, modulus, out=np.ones_like(modulus), where=modulus > self.limit)
        return np.asarray(tractions * share, np.float64)

    def face(self, tractions: Floats, push: Floats | None) -> Face:
        modulus = np.hypot(*tractions)
        held = modulus >= self.limit * (1.0 - 1e-12)
        if push is not None:
            held &= np.einsum("iyx,iyx->yx", tractions, push) >= 0.0
        direction = np.divide(tractions, modulus, out=np.zeros_like(tractions), where=held & (modulus > 0.0))
        if push is None:
            return Face(self.limit > 0.0, direction)
        outward = np.einsum("iyx,iyx->yx", direction, push)
        curvature = np.divide(outward, modulus, out=np.zeros_like(modulus), where=modulus > 0.0)
        return Face(self.limit > 0.0, direction, curvature)

    def yielding(self, tractions: Floats) -> Floats:
        modulus = np.hypot(*tractions)
        beyond = modulus > self.limit
        share = np.divide(self.limit, modulus, out=np.ones_like(modulus), where=beyond)
        share[self.limit == 0.0] = 0.0
        direction = np.divide(tractions, modulus, out=np.zeros_like(tractions), where=beyond)
        turned = np.einsum("yx,iyx,jyx->ij", share, direction, direction)
        return np.asarray((share.sum() + 1e-12) * np.eye(2) - turned, np.float64)


@dataclass(frozen=True)
class Minimum:
    """Solution of `minimise`."""

    tractions: Floats  # (components, ny, nx)
    shift: Floats  # (components, 1, 1); 0 where no sum was prescribed
    residuals: tuple[float, ...]  # one an iteration; the last one is certified with a fresh product A f


def minimise(
    compliance: LinearMap,
    target: Floats,
    bounds: Bounds,
    start: Floats,
    *,
    self_compliance: float,
    precondition: LinearMap,
    sums: Floats | None = None,
    tolerance: float = 1e-8,
    iterations_max: int = 2000,
) -> Minimum:
    """Minimise f.A f / 2 - f.target over the bounds, and over those of sum `sums` (components,), NaN where none is.

    The residual that is compared with `tolerance` is |f - nearest(f + slack / self_compliance)| / |f|: it is 0 at the
    solution and nowhere else, whatever the bounds (the natural map of Karush, Kuhn and Tucker's conditions). What the
    sum misses counts likewise, relative to the sum of moduli.

    Steps are preconditioned conjugate gradients within the current face of the bounds, then the nearest allowed
    tractions (Polonsky and Keer 1999, with Polak and Ribiere's update). Where such a step lowers the energy too
    little, a projected gradient step, which always lowers it enough, takes its place: so the energy falls in each
    iteration and no state comes twice, where the method as published can go round in circles.

    Raises NotConvergedError after `iterations_max`, where the residual no longer falls, and where numbers are so large
    or small that their squares have no value; ValueError for a tolerance that is not above 0 and below 1.
    """

    def nearest(tractions: Floats) -> Floats:
        return bounds.nearest(tractions) if sums is None else _nearest_of_sum(bounds, tractions, sums)

    check_tolerance(tolerance)
    balanced = np.zeros(len(target), np.bool_) if sums is None else np.isfinite(sums)
    directions = _ConjugateDirections(precondition, self_compliance, balanced)
    step_length = 1.0 / self_compliance  # of the projected gradient, halved until it is safe
    f = nearest(start)
    response, fresh = compliance(f), True
    shift = np.zeros((len(target), 1, 1))
    residuals: list[float] = []
    best, best_at = np.inf, 0
    while True:
        slack = target - response
        if sums is not None:
            shift = -bounds.face(f, None).means(slack, balanced)
            slack = slack + shift
        gap = bounds.nearest(f + slack / self_compliance) - f
        natural, size = float(np.linalg.norm(gap)), float(np.linalg.norm(f))
        residual = natural / size if size else float(gap.any())
        if sums is not None:
            residual = max(residual, _missing(f, sums))
        if not np.isfinite(residual):
            raise NotConvergedError(_BEYOND_NUMBERS, tuple(residuals))
        if residual <= tolerance and not fresh:
            response, fresh = compliance(f), True
            directions.restart()
            continue
        residuals.append(residual)
        if residual <= tolerance:
            return Minimum(f, shift, tuple(residuals))
        if residual < 0.9 * best:
            best, best_at = residual, len(residuals)
        face = bounds.face(f, slack)
        direction, slope = directions.next(face, slack)
        moved = compliance(direction)
        stiffness = float(np.vdot(direction, moved)) + face.bend(direction)
        stalls = len(residuals) - best_at >= _STALL_ITERATIONS or not (slope > 0.0 and stiffness > 0.0)
        if stalls or len(residuals) > iterations_max:
            raise NotConvergedError(
                f"residual stays at {best:.2g} after {len(residuals)} iterations, must reach {tolerance:.2g}",
                tuple(residuals),
            )
        length = slope / stiffness
        aim = f + length * direction
        allowed = nearest(aim)
        if np.array_equal(allowed, aim):
            f, response, fresh = aim, response + length * moved, False
            continue
        change = allowed - f
        moved = compliance(change)
        if np.vdot(slack, change) - 0.5 * np.vdot(change, moved) < 0.5 * step_length * (self_compliance * natural) ** 2:
            directions.restart()
            while True:
                change = nearest(f + step_length * slack) - f
                moved = compliance(change)
                if not np.vdot(change, moved) > np.vdot(change, change) / step_length:
                    break
                step_length /= 2.0
        f, response, fresh = f + change, response + moved, False


class _ConjugateDirections:
    """Search directions within a face that changes: preconditioned, conjugate after Polak and Ribiere."""

    def __init__(self, precondition: LinearMap, self_compliance: float, balanced: Bools) -> None:
        self._precondition = precondition
        self._self_compliance = self_compliance
        self._balanced = balanced  # components that keep their sum
        self._last: tuple[Floats, Floats, Floats] | None = None  # direction, push, eased push

    def restart(self) -> None:
        self._last = None

    def next(self, face: Face, slack: Floats) -> tuple[Floats, float]:
        """Direction (components, ny, nx), and how fast the energy falls along it."""
        push = self._within(face, slack)
        soft = 1.0 if face.curvature is None else 1.0 / np.sqrt(1.0 + face.curvature / self._self_compliance)
        eased = self._within(face, soft * self._precondition(soft * push))
        direction = eased
        if self._last is not None:
            last_direction, last_push, last_eased = self._last
            gain = float(np.vdot(eased, push - last_push) / np.vdot(last_eased, last_push))
            direction = eased + max(0.0, gain) * self._within(face, last_direction)
            if np.vdot(direction, push) <= 0.0:
                direction = eased
        self._last = direction, push, eased
        return direction, float(np.vdot(direction, push))

    def _within(self, face: Face, vectors: Floats) -> Floats:
        return face.restrict(vectors - face.means(vectors, self._balanced) if self._balanced.any() else vectors)


def _missing(tractions: Floats, sums: Floats) -> float:
    """How far tractions are from their sum, relative to the sum of their moduli or to the sum wanted."""
    short = np.where(np.isfinite(sums), sums - tractions.sum(axis=(1, 2)), 0.0)
    scale = max(float(np.abs(tractions).sum()), float(np.nansum(np.abs(sums))))
    return float(np.abs(short).max()) / scale if scale else 0.0


def _nearest_of_sum(bounds: Bounds, tractions: Floats, sums: Floats) -> Floats:
    """Project onto the tractions within the bounds that have this sum: Newton's method on their common offset.

    Where most pixels are at their bounds the sum hardly yields, and Newton's steps would go astray: none is longer than
    what is there already, and one that overshoots is halved. The sum is a convex function's gradient.
    """
    offset = np.zeros((len(sums), 1, 1))
    balanced = np.isfinite(sums)

    def pull(offset: Floats) -> tuple[Floats, Floats]:
        allowed = bounds.nearest(tractions + offset)
        return allowed, np.where(balanced, sums - allowed.sum(axis=(1, 2)), 0.0)

    allowed, missing = pull(offset)
    for _ in range(100):
        if np.linalg.norm(missing) <= 1e-14 * np.abs(allowed).sum():
            break
        yielding = bounds.yielding(tractions + offset) * np.outer(balanced, balanced) + np.diag(~balanced)
        step = np.linalg.solve(yielding, missing)
        reach = np.abs(tractions + offset).max() + np.abs(missing).max() / tractions[0].size
        step *= min(1.0, reach / float(np.linalg.norm(step)))
        before = float(step @ missing)
        while True:
            allowed, missing = pull(offset + step.reshape(offset.shape))
            if not step @ missing < -0.5 * before:
                break
            step, before = step / 2.0, before / 2.0
        offset += step.reshape(offset.shape)
    return allowed
