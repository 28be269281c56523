"""Least-squares fit of few bounded parameters to the signals of one frame."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from resonator_daemon.base.arrays import Floats

_STEPS = 30
_DAMPING = 1e-3
_DAMPING_LIMIT = 1e8
_UNEXPLAINED_LIMIT = 0.03  # share of the signals' energy that another kind of contact leaves ...
_CHI2_LIMIT = 1.5  # ... beyond what the noise hides
_SETTLED = 1e-2  # expected fall of chi-square, below which what is left is within a tenth of a standard deviation
_SINGULAR = 1e12  # condition of the correlations, from which parameters count as undetermined


@dataclass(frozen=True)
class Fit:
    """Where chi-square is least."""

    parameters: Floats  # (p,)
    precision: Floats  # (p, p), inverse covariance for the declared noise
    chi_square: float
    count: int  # of signals
    energy: float  # sum of squares of the signals in units of the noise

    @property
    def degrees_of_freedom(self) -> int:
        return max(self.count - self.parameters.size, 1)

    @property
    def chi2(self) -> float:
        """Mean square of the residual in units of the noise."""
        return self.chi_square / self.degrees_of_freedom

    @property
    def unexplained(self) -> float:
        """Share of the signals' energy that neither model nor noise explains."""
        signal = self.energy - self.count
        return float(max(self.chi_square - self.count, 0.0) / signal) if signal > 0.0 else 1.0

    @property
    def doubt(self) -> str | None:
        """Why the model does not hold for these signals; None where it does, or where the noise hides it."""
        if self.chi2 > _CHI2_LIMIT and self.unexplained > _UNEXPLAINED_LIMIT:
            return f"{self.unexplained:.0%} of the signals' energy fits no such contact, chi2 {self.chi2:.3g}"
        return None

    @cached_property
    def covariance(self) -> Floats:
        """(p, p), for noise as large as the residual where that exceeds the declared one.

        Infinite for all parameters where the signals leave one undetermined.
        """
        scale = np.sqrt(self.precision.diagonal())
        if not scale.all():
            return np.full_like(self.precision, np.inf)
        scales = scale * scale[:, None]
        try:
            inverse = np.linalg.inv(self.precision / scales)
        except np.linalg.LinAlgError:
            return np.full_like(self.precision, np.inf)
        if not np.linalg.norm(inverse) < _SINGULAR:
            return np.full_like(self.precision, np.inf)
        found: Floats = inverse / scales * max(self.chi2, 1.0)
        return found


@dataclass(frozen=True)
class Expansion:
    """Chi-square about some parameters, to second order in them."""

    chi_square: float
    gradient: Floats  # (p,), half of the fall of chi-square by the parameters
    precision: Floats  # (p, p), half of its second derivative


Expanded = TypeVar("Expanded", bound=Expansion)


def minimise(
    expand: Callable[[Floats], Expanded], start: Floats, lower: Floats, upper: Floats, count: int
) -> tuple[Floats, Expanded]:
    """Minimise a chi-square of so many signals between bounds; returns the parameters and its expansion there."""
    parameters = np.clip(start, lower, upper)
    best = expand(parameters)
    damping = _DAMPING
    for _ in range(_STEPS):
        if damping > _DAMPING_LIMIT:
            break
        step = _step(parameters, lower, upper, best.gradient, best.precision, damping)
        if 0.5 * float(best.gradient @ step) < _SETTLED * max(best.chi_square / count, 1.0):
            break
        tried = np.clip(parameters + step, lower, upper)
        found = expand(tried)
        if found.chi_square > best.chi_square:
            damping *= 10.0
            continue
        parameters, best = tried, found
        damping *= 0.1
    return parameters, best


def _step(
    parameters: Floats, lower: Floats, upper: Floats, gradient: Floats, precision: Floats, damping: float
) -> Floats:
    """Damped Gauss-Newton step among the parameters that do not lie at a bound they press against."""
    free = ~(((parameters <= lower) & (gradient < 0.0)) | ((parameters >= upper) & (gradient > 0.0)))
    inner = precision[np.ix_(free, free)]
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    scaled = inner / np.outer(scale, scale) + damping * np.eye(scale.size)
    step = np.zeros_like(parameters)
    step[free] = np.linalg.solve(scaled, gradient[free] / scale) / scale
    return step
