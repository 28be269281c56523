"""Fits of a flat round punch and of an ellipse to contacts that contradict a ball."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.decoded import KNOWN_LIMIT
from resonator_daemon.estimate.surface.fitting.contact_fit import Fit
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.ellipse import EllipseProblem
from resonator_daemon.estimate.surface.fitting.partial_slip import MARGIN_STD_LIMIT, PartialSlip, describe
from resonator_daemon.estimate.surface.fitting.slip_problem import Frame, Linearisation, Settled, SlipProblem
from resonator_daemon.estimate.surface.fitting.slip_signals import FORCE_X, MARGIN, PARAMETERS, RADIUS
from resonator_daemon.estimate.surface.fitting.systematic import Offset, offset_of, systematic_covariances
from resonator_daemon.estimate.surface.patches import Patch
from resonator_daemon.estimate.surface.skin import Skin

Shape = Literal["punch", "ellipse"]
_STICKS: Final = Reason(ReasonCode.NO_SLIP_MARGIN, "a flat punch sticks as a whole until it slides")
_NO_MARGIN: Final = {0: 0.0}  # of a punch, whose shear is spread as its pressure
_LEAST_FOCUS_M: Final = 1e-12  # a smaller one has no direction
_EXACT: Final = 1e12  # precision of a margin that is held
_DIRECTIONS: Final = np.arange(6) * np.pi / 6.0  # of the long half-axis that are tried as starts
_SHORT, _FOCUS, _MARGIN = 0.84, 0.85, 0.5  # of that start: short half-axis and focus over the patch's radius; margin


@dataclass(frozen=True)
class ShapeFit:
    """One contact in one frame."""

    shape: Shape
    slip: PartialSlip  # `radius_m` is that of a disc of equal area, the covariances are those of the short half-axis
    short_half_axis_m: float
    short_half_axis_std_m: float
    long_half_axis_m: Floats  # x and y >= 0 of an end, (2,); NaN for a punch
    long_half_axis_std_m: Floats
    offset: Offset  # that the fit leaves
    linearisation: Linearisation  # near the minimum


class ShapeFitter:
    """Fit of a punch and of an ellipse to single contacts on a skin.

    Parameters
    ----------
    skin
    noise_std
        Of the signals, gain errors aside, (3, n).
    radius_max_m
        Of a contact.
    """

    def __init__(self, skin: Skin, noise_std: Floats, radius_max_m: float) -> None:
        self._skin, self._noise_std = skin, noise_std
        of_skin = skin.half_space, skin.site_positions_m, skin.depth_m, radius_max_m
        self._flat, self._even = DiscModel(*of_skin, power=-0.5), DiscModel(*of_skin, power=0.0)

    def fit(self, signals: Floats, noise_std: Floats, patch: Patch, pause: Callable[[], None]) -> ShapeFit | None:
        """Return the best fit of a frame, signals and their noise (3, n), from a patch; None where there is none.

        `pause` is called between parts, which take about 3 ms each.
        """
        frame = Frame(self._flat, signals, noise_std, None)
        start = np.array([*patch.centroid_m, patch.radius_m, *patch.force_newton, 0.0])
        punch = SlipProblem(self._flat, frame, [None])
        ellipse = EllipseProblem(self._even, frame, pause)
        foci_m = _FOCUS * patch.radius_m * np.column_stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)])
        long = np.array([*start[:RADIUS], _SHORT * patch.radius_m, *start[FORCE_X:MARGIN], _MARGIN])
        best = min((np.append(long, focus_m) for focus_m in foci_m), key=ellipse.chi_square)
        one = self._described("punch", punch, punch.from_parameters(start, _NO_MARGIN), margin_known=False)
        other = self._described("ellipse", ellipse, ellipse.from_parameters(best, {}), margin_known=True)
        return min((fit for fit in (one, other) if fit is not None), key=lambda fit: fit.slip.chi2, default=None)

    def follow(self, before: ShapeFit, signals: Floats, noise_std: Floats) -> ShapeFit | None:
        """Fit a shape to the frame after one that it was fitted to; None if the fit fails."""
        at, margin_std = before.linearisation, math.sqrt(before.slip.covariance[MARGIN, MARGIN])
        frame = Frame(self._flat, signals, noise_std, at.whitening)
        if frame.count < KNOWN_LIMIT * frame.target.size:
            return None
        is_punch = before.shape == "punch"
        problem = (
            SlipProblem(self._flat, frame, [None]) if is_punch else EllipseProblem(self._even, frame, lambda: None)
        )
        margin_known = not is_punch and margin_std < MARGIN_STD_LIMIT
        settled = problem.from_before(at, {} if margin_known else {0: float(at.parameters[MARGIN])})
        return None if settled is None else self._described(before.shape, problem, settled, margin_known=margin_known)

    def _described(
        self, shape: Shape, problem: SlipProblem, settled: Settled, *, margin_known: bool
    ) -> ShapeFit | None:
        """Describe a fit; None where the signals do not determine the contact, or it does not explain them."""
        precision, parameters, at = settled.precision.copy(), settled.parameters, settled.linearisation
        precision[MARGIN, MARGIN] += _EXACT * (shape == "punch")
        fit = Fit(parameters, precision, settled.chi_square, problem.count, problem.frame.energy)
        covariance = fit.covariance
        of_noise = covariance / max(fit.chi2, 1.0)
        if not np.isfinite(of_noise).all():
            return None
        offset = offset_of(problem.frame, settled, of_noise, self._noise_std)
        systematic = systematic_covariances(self._skin, at, of_noise)[0] + offset.moved @ offset.moved.T
        of_round, radius_max_m = (slice(PARAMETERS),) * 2, self._flat.radius_max_m
        numbers = parameters[:PARAMETERS], covariance[of_round], systematic[of_round], radius_max_m
        slip = describe(fit, *numbers, margin_known=margin_known)
        if math.isnan(slip.radius_m):
            return None
        lengths = [RADIUS, *range(PARAMETERS, len(parameters))]  # the short half-axis, the focus
        focus_m, short_m, long_m = parameters[PARAMETERS:], slip.radius_m, float(np.linalg.norm(parameters[lengths]))
        radius_m, end_m = math.sqrt(long_m * short_m), np.full(2, math.nan)
        by_short, by_long = np.eye(len(lengths))[0], parameters[lengths] / long_m
        slopes = [by_short, 0.5 * radius_m * (by_short / short_m + by_long / long_m)]
        if focus_m.size:
            distance_m = max(float(np.linalg.norm(focus_m)), _LEAST_FOCUS_M)
            along = focus_m / distance_m
            end_m = math.copysign(long_m, focus_m[1]) * along
            turned = long_m / distance_m * (np.eye(2) - np.outer(along, along))
            slopes += list(np.outer(along, by_long) + np.column_stack([np.zeros(2), turned]))
        covariance = np.array(slopes) @ covariance[np.ix_(lengths, lengths)] @ np.array(slopes).T
        short_std_m, radius_std_m, *end_std_m = np.sqrt(covariance.diagonal()).tolist()
        slip = replace(slip, radius_m=radius_m, radius_std_m=radius_std_m)
        if shape == "punch":
            slip = replace(slip, reason=_STICKS)
        return ShapeFit(shape, slip, short_m, short_std_m, end_m, np.array(end_std_m or [math.nan] * 2), offset, at)
