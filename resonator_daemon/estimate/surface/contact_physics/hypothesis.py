"""Hypothesis about a contact from the frames so far, and the test of it against a frame that it does not explain."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from resonator_daemon.base.arrays import Bools, Singles
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.contact_physics.support_problem import project_on_cone
from resonator_daemon.estimate.surface.contact_physics.support_search import Frame, Located, SupportSearch

Bounds = Literal["all", "cone", "none"]  # kept: all; a cone of unknown friction; none

UNKNOWN_FRICTION = 3.0  # a coefficient that no dry contact reaches
_CONVERGED = 60  # iterations
_STEPS = 4  # of finding out why a solution does not explain the signals
_BOUNDS_COST = 0.1  # in chi2: what bounds that hold never cost


@dataclass(frozen=True)
class Hypothesis:
    """Where a contact may be, and its bounds."""

    located: Located | None
    missed: Bools  # pixels (ny, nx) around load that the linear map does not show
    bounds: Bounds = "all"
    reason: Reason | None = None  # why it differs from the linear map and the friction coefficient


@dataclass(frozen=True)
class Solved:
    """What one frame's iterations led to, on the n pixels of its problem."""

    frame: Frame
    located: Located
    right_side: Singles  # (3 n,)
    inside: Bools  # pixels that may carry load, (n,)
    traction: Singles  # (3, n)
    multiplier: Singles
    chi2: float

    @property
    def is_sound(self) -> bool:
        """Whether it explains the signals."""
        return self.chi2 <= self.frame.chi2_limit + self.located.model_chi2(self.frame)

    def on(self, located: Located) -> tuple[Singles, Singles]:
        """Return the traction and multiplier on the pixels of another problem."""
        if located is self.located:
            return self.traction, self.multiplier
        whole = np.zeros((2, 3, located.solved.size), np.float32)
        whole[..., self.located.problem.pixels] = self.traction, self.multiplier
        return tuple(whole[..., located.problem.pixels])


def solve(
    frame: Frame, located: Located, friction: float, before: Solved | None, iterations: int, most: int = 0
) -> Solved:
    """Return the traction in the friction cone, from where the frame before ended or from the linear map.

    Iterations go on one by one, up to `most`, until the traction explains the signals.
    """
    problem, inside = located.problem, located.inside(frame)
    if before is None:
        traction = project_on_cone(frame.traction[:, problem.pixels], friction) * inside
        multiplier = np.zeros_like(traction)
    else:
        traction, multiplier = before.on(located)
    right_side = problem.right_side(frame.rows)
    while True:
        traction, multiplier = problem.constrained(right_side, friction, inside, traction, multiplier, iterations)
        chi2 = problem.chi2(frame.rows, right_side, traction) / frame.noise_floor
        solved = Solved(frame, located, right_side, inside, traction, multiplier, chi2)
        most -= iterations
        if solved.is_sound or most <= 0:
            return solved
        iterations = 1


def examine(
    search: SupportSearch,
    frame: Frame,
    hypothesis: Hypothesis,
    friction_of: Callable[[Bounds], float],
    before: Solved | None,
    pause: Callable[[], None] = lambda: None,
) -> tuple[Hypothesis, Solved | None]:
    """Return the hypothesis that explains a frame and its solution; None if all bounds are given up.

    In turn: more iterations, a larger support, fewer bounds.

    Parameters
    ----------
    search
    frame
    hypothesis
        To begin with.
    friction_of
        Friction coefficient under given bounds.
    before
        Solution to begin with.
    pause
        As of `ContactDecoder.rebuild`.
    """
    located = hypothesis.located or search.locate(frame, hypothesis.missed, None, pause)
    for _ in range(_STEPS):
        pause()
        friction = friction_of(hypothesis.bounds)
        before = solved = solve(frame, located, friction, before, _CONVERGED)
        if solved.is_sound:
            return hypothesis, solved
        pause()
        problem, by_pixels = located.problem, located.model_chi2(frame)
        free = problem.linear(solved.right_side, solved.inside, solved.traction)
        chi2 = problem.chi2(frame.rows, solved.right_side, free) / frame.noise_floor
        if chi2 > frame.chi2_limit + by_pixels:
            missed = hypothesis.missed | search.missed_load(frame, problem, free)
            if not (missed & ~located.found).any():
                break
            text = "load outside the support, found in what that left of the signals"
            reason = Reason(ReasonCode.SUPPORT_ENLARGED, text)
            located = search.locate(frame, missed, located, pause)
            hypothesis = replace(hypothesis, located=located, missed=missed, reason=reason)
        elif solved.chi2 <= chi2 + _BOUNDS_COST * frame.excess + by_pixels:
            return hypothesis, solved
        elif friction < UNKNOWN_FRICTION:
            what = f"friction coefficient {friction:.3g} contradicted"
            text = f"{what}, chi2 {solved.chi2:.3g} for {chi2:.3g}; bound by {UNKNOWN_FRICTION:.0f}"
            reason = Reason(ReasonCode.FRICTION_CONTRADICTED, text)
            hypothesis = replace(hypothesis, bounds="cone", reason=reason)
        else:
            what = f"a load that only presses contradicted, chi2 {solved.chi2:.3g} for {chi2:.3g}"
            return _given_up(hypothesis, what), None
    what = f"no load on the support explains the signals, chi2 {chi2:.3g}"
    return _given_up(hypothesis, what), None


def _given_up(hypothesis: Hypothesis, what: str) -> Hypothesis:
    reason = Reason(ReasonCode.PHYSICS_CONTRADICTED, f"{what}; the linear map is shown")
    return replace(hypothesis, bounds="none", reason=reason)
