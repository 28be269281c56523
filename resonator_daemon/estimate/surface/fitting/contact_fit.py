"""Least-squares fit of few bounded parameters to the signals of one frame, and the search for where it begins.

Before anything is known of a contact, every centre is tried, its force by linear least squares.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel

# Parameters (p,) to signals (k,) and their derivatives (p, k).
Model = Callable[[Floats], tuple[Floats, Floats]]

_STEPS = 30
_DAMPING = 1e-3
_DAMPING_LIMIT = 1e8
_UNEXPLAINED_LIMIT = 0.03  # share of the signals' energy that another kind of contact leaves ...
_CHI2_LIMIT = 1.5  # ... beyond what the noise hides
_SETTLED = 1e-2  # expected fall of chi-square, below which what is left is within a tenth of a standard deviation
_SINGULAR = 1e12  # condition of the correlations, from which parameters count as undetermined

_STEP_DEPTHS = 0.5  # a fit finds the centre from there
_CENTRES_MAX = 4000
_RADII_DEPTHS = (0.7, 2.0)  # a disc in between looks much the same


@dataclass(frozen=True)
class Fit:
    """Where chi-square is least."""

    parameters: Floats  # (p,)
    precision: Floats  # (p, p), inverse covariance for the declared noise
    chi_square: float
    count: int  # of signals
    energy: float  # sum of squares of the signals in units of the noise

    @property
    def chi2(self) -> float:
        """Mean square of the residual in units of the noise."""
        return self.chi_square / max(self.count - self.parameters.size, 1)

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

    @property
    def log_evidence(self) -> float:
        """Log density of the signals, less a constant, if one signal's worth was known of each parameter before.

        Schwarz's criterion (Kass and Wasserman, J. Am. Stat. Assoc. 90, 1995, 928), the noise as in `covariance`.
        """
        excess = max(self.chi2, 1.0)
        penalty = self.parameters.size * math.log(self.count)
        return -0.5 * (self.chi_square / excess + self.count * math.log(excess) + penalty)


@dataclass(frozen=True)
class Expansion:
    """Chi-square about some parameters, to second order in them."""

    chi_square: float
    gradient: Floats  # (p,), half of the fall of chi-square by the parameters
    precision: Floats  # (p, p), half of its second derivative


Expanded = TypeVar("Expanded", bound=Expansion)


def fit(model: Model, start: Floats, lower: Floats, upper: Floats, signals: Floats, noise_std: Floats) -> Fit:
    """Minimise chi-square between bounds, by steps of Levenberg and Marquardt.

    Parameters
    ----------
    model
    start, lower, upper
        (p,).
    signals, noise_std
        (k,); signals that are NaN or infinite are left out.

    Raises
    ------
    ValueError
        Fewer known signals than parameters, or a noise that is not above 0.
    """
    known = np.isfinite(signals)
    everything = bool(known.all())
    count = int(known.sum())
    if count < start.size:
        raise ValueError(f"{count} signals are known, must be at least {start.size}, as many as there are parameters")
    if not (noise_std > 0.0).all():
        raise ValueError(f"noise_std reaches {noise_std.min()}, must be above 0")
    whiten = 1.0 / noise_std
    target = signals * whiten
    if not everything:
        whiten, target = whiten[known], target[known]

    def expand(parameters: Floats) -> Expansion:
        value, slopes = model(parameters)
        if not everything:
            value, slopes = value[known], slopes[:, known]
        left, slopes = target - value * whiten, slopes * whiten
        return Expansion(float(left @ left), slopes @ left, slopes @ slopes.T)

    parameters, found = minimise(expand, start, lower, upper, count)
    return Fit(parameters, found.precision, found.chi_square, count, float(target @ target))


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


class Candidate(NamedTuple):
    """A place that explains the signals better than those around it."""

    centre_m: Floats  # (2,)
    radius_m: float
    force_newton: Floats  # (3,)


class CentreSearch:
    """A raster of centres, each with discs of a few radii.

    Parameters
    ----------
    model
    noise_std
        Of the signals, (3 n,).
    lowest_m, highest_m
        Corners of the rectangle of centres, (2,).
    """

    def __init__(self, model: DiscModel, noise_std: Floats, lowest_m: Floats, highest_m: Floats) -> None:
        depth_m = model.depth_m
        side_m = highest_m - lowest_m
        step_m = max(_STEP_DEPTHS * depth_m, float(np.sqrt(side_m.prod() / _CENTRES_MAX)))
        axes = [
            np.linspace(low, high, 2 + int((high - low) / step_m))
            for low, high in zip(lowest_m, highest_m, strict=True)
        ]
        self.centres_m = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        self.radii_m = np.array([min(radius * depth_m, model.radius_max_m) for radius in _RADII_DEPTHS])
        self._apart_m = 2.0 * depth_m
        columns = [
            model.signals(centre, float(radius)).value.reshape(3, -1) / noise_std
            for centre in self.centres_m
            for radius in self.radii_m
        ]
        self._columns = np.array(columns, np.float32)  # (centres x radii, 3, 3 n)
        self._known: Bools = np.zeros(noise_std.size, np.bool_)
        self._covariance: Floats = np.empty((0, 3, 3))

    def candidates(self, whitened: Floats, known: Bools, count: int) -> list[Candidate]:
        """Return the best places for whitened signals (3 n,), lost ones 0, best first.

        They lie at least two depths apart, and their discs press.
        """
        covariance = self._force_covariance(known)
        columns = self._columns.reshape(-1, whitened.size)
        seen = (columns @ whitened.astype(np.float32)).reshape(-1, 3, 1).astype(np.float64)
        forces = (covariance @ seen)[..., 0]
        fall = np.where(forces[:, 2] > 0.0, np.sum(forces * seen[..., 0], axis=1), 0.0)
        fall = fall.reshape(len(self.centres_m), -1)
        best_radius = fall.argmax(axis=1)
        fall = fall.max(axis=1)
        found: list[Candidate] = []
        while len(found) < count and fall.max() > 0.0:
            place = int(fall.argmax())
            radius = int(best_radius[place])
            force = forces[place * len(self.radii_m) + radius]
            found.append(Candidate(self.centres_m[place], float(self.radii_m[radius]), force))
            fall[np.hypot(*(self.centres_m - self.centres_m[place]).T) < self._apart_m] = 0.0
        return found

    def force_std_newton(self, known: Bools) -> Floats:
        """Error of the force of the smaller disc, if it were at a centre: (centres, 3)."""
        smaller = self._force_covariance(known)[:: len(self.radii_m)]
        return np.asarray(np.sqrt(np.diagonal(smaller, axis1=1, axis2=2)), np.float64)

    def _force_covariance(self, known: Bools) -> Floats:
        """Of each place, (centres x radii, 3, 3); kept for as long as the same signals are known."""
        if not np.array_equal(known, self._known):
            columns = self._columns * known
            precision = (columns @ columns.transpose(0, 2, 1)).astype(np.float64)
            least = 1e-9 * float(np.trace(precision, axis1=1, axis2=2).max())  # where nothing is felt, a large error
            self._covariance = np.asarray(np.linalg.inv(precision + least * np.eye(3)), np.float64)
            self._known = known
        return self._covariance
