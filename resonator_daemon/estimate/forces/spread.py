"""Multi-touch from forces spread over neighbouring sites: number, positions and forces.

Under a cover of depth w a touch of force F at distance r loads a site with F (1 + r^2 / w^2)^(-3/2), the normal stress
below a point load on a half-space (Johnson, Contact Mechanics, 1985, section 3.2). Sites are known to a relative model
error besides their noise.
"""

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from scipy.spatial import Delaunay, QhullError
from scipy.special import chdtri

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode

TOUCHES_MAX: Final = 4
EXCEEDED_BY_CHANCE: Final = 1e-3
GAIN_MIN: Final = 25.0  # chi2 that one more touch, three numbers and a place to choose, has to explain
GAIN_START: Final = 6.0  # a place between the starts may explain some times more than they
RELOCATIONS_MAX: Final = 6
PRUNE_BELOW: Final = 4.0  # a force of 10 standard deviations is not in doubt
SEPARATION_MIN: Final = 0.5  # in cover depths: closer ones are one touch
REACH: Final = 1.0  # in cover depths: so far outside the sites' box a touch is looked for
STARTS: Final = 3
STEPS_MAX: Final = 40
FOLLOW_STEPS_MAX: Final = 8  # from a solution that is nearly there
STEP_TOLERANCE: Final = 1e-2  # of a standard deviation
DAMPING_START: Final = 1e-3
DAMPING_MAX: Final = 1e6

NOTHING: Final = (np.zeros((0, 3)), np.zeros((0, 0)))  # touches and their covariance

_NO_SITE: Final = Reason(ReasonCode.NO_TONE, "no site is known")

SpreadStatus = Literal["ok", "rejected", "no_signal"]


@dataclass(frozen=True, slots=True)
class Touches:
    """k touches: position (k, 2), force (k,) and their covariances (k, 3, 3), in the order x, y, force.

    `noise_newton` (k,) is the part of the forces' standard deviations that comes from the sites' noise alone.

    Under `rejected` they are those that explain most: all but `unexplained` of what the sites feel, by its square, and
    `reason` has that share. `freedom` counts the sites less the numbers that were fitted.
    """

    status: SpreadStatus
    reason: Reason | None
    position_m: Floats
    force_newton: Floats
    covariance: Floats
    noise_newton: Floats
    chi2: float
    freedom: int
    unexplained: float


class _Data(NamedTuple):
    """Observed sites: positions in cover depths (n, 2), forces, variances, and the share of noise in these."""

    position: Floats
    force: Floats
    noise: Floats
    noise_share: Floats


class _Fit(NamedTuple):
    """Touches (k, 3) as x, y in cover depths and F in newtons; covariance (3k, 3k) of all of them."""

    touches: Floats
    covariance: Floats
    chi2: float


class SpreadFit:
    """Weighted least squares of touches on the forces of n sites at arbitrary places."""

    def __init__(
        self,
        site_positions_m: Floats,
        depth_m: float,
        *,
        model_error: float,
        share_error: float = 0.0,
        outline_m: Floats | None = None,
    ) -> None:
        """Initialise with positions (n, 2), depth w of the cover, and the relative model error of a site.

        `share_error` is what each site's share of a touch may be off by, of the whole force: no cover spreads a touch
        exactly by the law, and far sites would else outweigh the near ones, whose errors grow with their force.
        Touches lie within the box of `outline_m` (p, 2), else within that of the sites and one depth around it: further
        out, distance and force make up for each other.
        """
        self._depth_m = depth_m
        self._model_error2 = model_error**2
        self._share_error2 = share_error**2
        self._position = site_positions_m / depth_m
        self._starts = _starts(self._position)
        reach = self._position if outline_m is None else outline_m / depth_m
        beyond = REACH if outline_m is None else 0.0
        self._low = reach.min(axis=0) - beyond
        self._high = reach.max(axis=0) + beyond

    def fit(
        self,
        force_newton: Floats,
        noise_variance: Floats,
        other_variance: Floats | float = 0.0,
        before: Touches | None = None,
        *,
        search: bool = True,
    ) -> Touches:
        """Find the touches behind site forces (n,) with variances (n,) of their noise; NaN for an unknown site.

        `other_variance` (n,) is that of other errors, independent from site to site as well. The touches of the reading
        `before` are tried first, and alone where `search` is false: a search takes milliseconds.
        """
        seen = np.isfinite(force_newton) & np.isfinite(noise_variance) & (noise_variance > 0)
        total = noise_variance + other_variance
        data = _Data(self._position[seen], force_newton[seen], total[seen], (noise_variance / total)[seen])
        if not seen.any():
            return self._touches("no_signal", _NO_SITE, data, _Fit(*NOTHING, np.nan))
        nothing = _Fit(*NOTHING, float(np.sum(data.force**2 / data.noise)))
        followed = self._followed(data, nothing, before) if before is not None else nothing
        if followed.chi2 <= self._gate(data, followed):
            return self._touches("ok", None, data, followed)
        best = self._searched(data, nothing) if search else followed
        gate = self._gate(data, best)
        if best.chi2 <= gate:
            return self._touches("ok", None, data, best)
        text = f"{len(best.touches)} touches leave chi2 = {best.chi2:.0f}, at most {gate:.0f}"
        return self._touches("rejected", Reason(ReasonCode.NO_TOUCHES_FIT, text), data, best)

    def _followed(self, data: _Data, nothing: _Fit, before: Touches) -> _Fit:
        """Refit the touches of the previous reading that are left."""
        scale = np.array([self._depth_m, self._depth_m, 1.0])
        touches = np.column_stack([before.position_m, before.force_newton]) / scale
        found = None
        if len(touches) and 3 * len(touches) <= len(data.force):
            found = self._refine(data, touches, FOLLOW_STEPS_MAX)
        return nothing if found is None else self._pruned(data, found, nothing)

    def _searched(self, data: _Data, nothing: _Fit) -> _Fit:
        best = nothing
        while 3 * len(best.touches) + 3 <= len(data.force) and len(best.touches) < TOUCHES_MAX:
            more = self._one_more(data, best)
            if more is None or best.chi2 - more.chi2 < GAIN_MIN:
                break
            best = self._relocated(data, more)
        return self._pruned(data, best, nothing)

    def _gate(self, data: _Data, fit: _Fit) -> float:
        freedom = len(data.force) - fit.touches.size
        return float(chdtri(freedom, EXCEEDED_BY_CHANCE)) if freedom else 0.0  # nothing is left to judge by

    def loads(self, touches: Touches, least_newton: float) -> Floats:
        """Return the force (n,) that touches of `least_newton` or more put on each site."""
        force = np.where(touches.force_newton >= least_newton, touches.force_newton, 0.0)
        return _share(self._position, touches.position_m / self._depth_m) @ force

    def _touches(self, status: SpreadStatus, reason: Reason | None, data: _Data, fit: _Fit) -> Touches:
        count = len(fit.touches)
        scale = np.array([self._depth_m, self._depth_m, 1.0])
        blocks = fit.covariance.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count), :]
        touches = fit.touches * scale
        covariance = blocks * np.outer(scale, scale)
        freedom = len(data.force) - touches.size
        prediction, jacobian = _predict(data.position, fit.touches)
        gain = fit.covariance @ (jacobian.T * self._weight(data, prediction))
        noise = np.sqrt((gain[2::3] ** 2) @ (data.noise * data.noise_share))
        left = data.force - prediction
        total = float(data.force @ data.force)
        unexplained = float(left @ left) / total if total > 0.0 else 0.0
        return Touches(status, reason, touches[:, :2], touches[:, 2], covariance, noise, fit.chi2, freedom, unexplained)

    def _one_more(self, data: _Data, fit: _Fit) -> _Fit | None:
        """Fit one touch more than `fit` has, from the places where it would explain most; None where none fits."""
        prediction, jacobian = _predict(data.position, fit.touches)
        inverse_std = np.sqrt(self._weight(data, prediction))
        residual = (data.force - prediction) * inverse_std
        templates = _share(data.position, self._starts) * inverse_std[:, None]
        basis, _ = np.linalg.qr(jacobian * inverse_std[:, None])
        templates -= basis @ (basis.T @ templates)
        residual -= basis @ (basis.T @ residual)
        norm2 = np.maximum(np.sum(templates**2, axis=0), 1e-12)
        projection = templates.T @ residual
        gain = np.where(projection > 0, projection**2 / norm2, 0.0)
        found: list[_Fit] = []
        for _ in range(STARTS):
            start = int(np.argmax(gain))
            if gain[start] < GAIN_START:
                break
            touch = np.append(self._starts[start], projection[start] / norm2[start])
            more = self._refine(data, np.vstack([fit.touches, touch]))
            if more is not None:
                found.append(more)
                if more.chi2 <= len(data.force) - more.touches.size:
                    break
            gain = np.where(np.sum((self._starts - self._starts[start]) ** 2, axis=1) < 1.0, 0.0, gain)
        return min(found, key=lambda more: more.chi2, default=None)

    def _relocated(self, data: _Data, fit: _Fit) -> _Fit:
        """Remove one touch after the other and search its place again, while chi2 exceeds its mean.

        A touch that was found while others were missing lies between them.
        """
        best = fit
        for _ in range(RELOCATIONS_MAX):
            for index in range(len(best.touches) if len(best.touches) > 1 else 0):
                if best.chi2 <= len(data.force) - best.touches.size:
                    return best
                others = self._refine(data, np.delete(best.touches, index, axis=0))
                found = others and self._one_more(data, others)
                if found and found.chi2 < best.chi2 - GAIN_START:
                    best = found
                    break
            else:
                break
        return best

    def _pruned(self, data: _Data, fit: _Fit, nothing: _Fit) -> _Fit:
        """Leave out touches that the others make up for, as one between two that were found later."""
        best = fit
        if len(best.touches) == 1 and nothing.chi2 - best.chi2 < GAIN_MIN:
            return nothing
        while len(best.touches) > 1:
            sigmas2 = best.touches[:, 2] ** 2 / np.diag(best.covariance)[2::3]
            weakest = int(np.argmin(sigmas2))
            if sigmas2[weakest] > PRUNE_BELOW * GAIN_MIN:
                break
            fewer = self._refine(data, np.delete(best.touches, weakest, axis=0), FOLLOW_STEPS_MAX)
            if fewer is None or fewer.chi2 - best.chi2 >= GAIN_MIN:
                break
            best = fewer
        return best

    def _refine(self, data: _Data, touches: Floats, steps: int = STEPS_MAX) -> _Fit | None:
        """Levenberg and Marquardt's steps; None where touches merge or vanish."""
        damping = DAMPING_START
        prediction, jacobian = _predict(data.position, touches)
        for _ in range(steps):
            weight = self._weight(data, prediction)
            residual = data.force - prediction
            chi2 = float(np.sum(weight * residual**2))
            weighted = jacobian.T * weight
            normal, gradient = weighted @ jacobian, weighted @ residual
            diagonal = np.diag(normal).copy()
            if not (diagonal > 0).all():
                return None
            while True:
                step = np.linalg.solve(normal + np.diag(damping * diagonal), gradient)
                trial = touches + step.reshape(-1, 3)
                trial[:, :2] = np.clip(trial[:, :2], self._low, self._high)
                trial_prediction, trial_jacobian = _predict(data.position, trial)
                if float(np.sum(weight * (data.force - trial_prediction) ** 2)) <= chi2:
                    break
                damping *= 10.0
                if damping > DAMPING_MAX:
                    return self._sound(touches, normal, chi2)
            touches, prediction, jacobian = trial, trial_prediction, trial_jacobian
            damping *= 0.1
            if float(step @ gradient) < STEP_TOLERANCE**2:
                break
        weight = self._weight(data, prediction)
        chi2 = float(np.sum(weight * (data.force - prediction) ** 2))
        return self._sound(touches, (jacobian.T * weight) @ jacobian, chi2)

    def _weight(self, data: _Data, prediction: Floats) -> Floats:
        """Weight of each site, its model error by the larger of prediction and force.

        By the force alone, low ones would be favoured; by the prediction, a touch not found yet would outweigh all.
        """
        largest = np.maximum(np.abs(prediction), np.abs(data.force))
        variance = (
            data.noise + self._model_error2 * largest**2 + self._share_error2 * float(largest.max(initial=0.0)) ** 2
        )
        return 1.0 / variance

    def _sound(self, touches: Floats, normal: Floats, chi2: float) -> _Fit | None:
        position = touches[:, :2]
        distance = np.linalg.norm(position[:, None] - position, axis=2) + np.diag(np.full(len(touches), np.inf))
        if (touches[:, 2] <= 0).any() or distance.min() < SEPARATION_MIN:
            return None
        try:
            return _Fit(touches, np.asarray(np.linalg.inv(normal), dtype=np.float64), chi2)
        except np.linalg.LinAlgError:
            return None


def _share(position: Floats, touch_position: Floats) -> Floats:
    """Share (n, k) of a touch's force that a site feels; positions in cover depths."""
    distance2 = np.sum((position[:, None] - touch_position) ** 2, axis=2)
    share: Floats = (1.0 + distance2) ** -1.5
    return share


def _predict(position: Floats, touches: Floats) -> tuple[Floats, Floats]:
    """Site forces (n,) of touches (k, 3) and their derivatives (n, 3k)."""
    offset = position[:, None] - touches[:, :2]
    base = 1.0 + np.sum(offset**2, axis=2)
    share = base**-1.5
    force = touches[:, 2]
    jacobian = np.empty((*share.shape, 3))
    jacobian[..., :2] = (3.0 * force * share / base)[..., None] * offset
    jacobian[..., 2] = share
    return share @ force, jacobian.reshape(len(position), touches.size)


def _starts(position: Floats) -> Floats:
    """Places among the sites where a touch may be: sites, middles between neighbours, and of three neighbours."""
    if len(position) < 3:
        return position
    try:
        triangles = position[Delaunay(position).simplices]
    except QhullError:  # all on one line
        return position
    middles = (triangles + np.roll(triangles, 1, axis=1)) / 2.0
    return np.vstack([position, np.unique(middles.reshape(-1, 2), axis=0), triangles.mean(axis=1)])
