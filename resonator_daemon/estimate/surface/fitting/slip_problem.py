"""Least squares of contacts in partial slip in one frame, from nothing and from where the frame before ended.

Parameters are x, y, a, F_x, F_y, F_z, m of each contact, one after the other. Chi-square has the signals, and one term
for each contact whose friction is known: by how much it breaks m = 1 - F_t / (mu F_z).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

from resonator_daemon.base.arrays import Bools, Floats, Singles
from resonator_daemon.estimate.surface.decoded import SIGNAL_LIMIT
from resonator_daemon.estimate.surface.fitting.contact_fit import Expansion, minimise
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart, Friction, bounds, clipped
from resonator_daemon.estimate.surface.fitting.slip_signals import (
    FORCE_X,
    FORCE_Z,
    MARGIN,
    PARAMETERS,
    ROWS,
    slope_rows,
)

FULL_STICK = 1.0 - 1e-4  # above it the margin leaves no trace in the signals, and 1 - m no digits
_MARGIN_STARTS = (0.15, 0.6)  # of which one leads to the least chi-square
_STEPS = 6  # between bounds, of one linearisation
_NEAR = 0.03  # of depth, force or margin: within it slopes are those of the linearisation
_MARGIN_SCALE = 0.7  # of the margin, as a depth is one of length; near 0 ...
_SLOPE_POWER = 2.0 / 3.0  # ... slopes go with this power of it
_SETTLED = 0.12  # standard deviations

_LAW_STD = 1e-3  # of the margin, to which the law is held where mu is exact
_LAW_CHANGED = 0.03  # relative, of a standard deviation
_LAW_LINEAR = 0.05  # standard deviations


class Whitening:
    """Weights of a frame's signals, which most often are those of the frame before.

    Parameters
    ----------
    model
    known
        Signals that are not lost, (3, n).
    noise_std
        Broadcastable to (3, n). ValueError where it is not above 0.

    Attributes
    ----------
    weights
        1 / noise_std, 0 for lost signals, (3, n).
    factors
        (3 n,), as of `SlipSignals.whiten`.
    """

    def __init__(self, model: DiscModel, known: Bools, noise_std: Floats) -> None:
        if not (noise_std > 0.0).all():
            raise ValueError(f"noise_std reaches {noise_std.min()}, must be above 0")
        self._known, self._noise_std = known, noise_std
        self.weights: Floats = np.where(known, 1.0 / noise_std, 0.0)
        self.factors = model.slip.whiten(self.weights)

    def serves(self, known: Bools, noise_std: Floats) -> bool:
        """Return whether the weights are those of other signals, too."""
        same_noise = noise_std is self._noise_std or np.array_equal(noise_std, self._noise_std)
        return same_noise and np.array_equal(known, self._known)


class Frame:
    """Signals of one frame in units of their noise.

    Parameters
    ----------
    model
    signals
        (3, n); lost ones NaN, infinite or beyond 10.
    noise_std
        Broadcastable to (3, n). ValueError where it is not above 0.
    before
        Whitening of the frame before.

    Attributes
    ----------
    whitening
    target
        (3 n,), lost ones 0.
    count
        Signals that are known.
    """

    def __init__(self, model: DiscModel, signals: Floats, noise_std: Floats, before: Whitening | None) -> None:
        known: Bools = np.abs(signals) <= SIGNAL_LIMIT  # False for NaN
        self.count = int(np.count_nonzero(known))
        same = before is not None and before.serves(known, noise_std)
        self.whitening = before if before is not None and same else Whitening(model, known, noise_std)
        sound = signals if self.count == signals.size else np.where(known, signals, 0.0)
        self.target: Singles = (sound * self.whitening.weights).astype(np.float32).ravel()

    @property
    def energy(self) -> float:
        """Sum of squares in units of the noise."""
        return float(self.target @ self.target)


class Linearisation:
    """Signals of contacts, in units of the noise, to first order about some parameters (7 k,)."""

    size = PARAMETERS  # parameters of a contact

    def __init__(self, model: DiscModel, parameters: Floats, whitening: Whitening) -> None:
        self.parameters = parameters
        self.whitening = whitening
        contacts = parameters.size // PARAMETERS
        self.rows = rows = np.empty((ROWS * contacts, whitening.factors.size), np.float32)
        scales = [
            model.slip.fill(one, whitening.factors, rows[ROWS * index : ROWS * (index + 1)])
            for index, one in enumerate(parameters.reshape(-1, PARAMETERS))
        ]
        self.value: Singles = rows[0] if contacts == 1 else rows[::ROWS].sum(axis=0)
        self.scale = scales[0] if contacts == 1 else np.concatenate(scales)
        self.slopes = slope_rows(contacts)
        # Products of rows with those from the second one on: of a matrix with itself they take three times as long.
        products = (rows @ rows[1:].T)[self.slopes].take(self.slopes - 1, axis=1)
        self.precision: Floats = products * self.scale * self.scale[:, None]

    def left(self, target: Singles) -> tuple[float, Floats]:
        """Chi-square of signals (3 n,) and its gradient (7 k,) at the parameters, without the law of friction."""
        residual = target - self.value
        return float(residual @ residual), self.project(residual)

    def project(self, signals: Singles) -> Floats:
        """Return the products of the slopes by each parameter with whitened signals (3 n,), or (m, 3 n), (7 k, m)."""
        products = (self.rows @ signals.T)[self.slopes]
        return np.asarray((products.T * self.scale).T, np.float64)


class Breach(NamedTuple):
    """By how much a contact breaks the law, in standard deviations."""

    value: float
    slopes: Floats  # (4,), by F_x, F_y, F_z, m


class FrictionLaw(NamedTuple):
    """Law m = 1 - F_t / (mu F_z) of one contact."""

    rows: slice  # of F_x, F_y, F_z, m among the parameters
    coefficient: float
    margin_std: float  # to which it holds

    @classmethod
    def of(cls, contact: int, friction: Friction, parameters: Floats) -> "FrictionLaw":
        """Return the law of a contact, by index: the more friction its forces use, the less exact it is."""
        rows = slice(PARAMETERS * contact + FORCE_X, PARAMETERS * (contact + 1))
        used = used_friction(parameters[rows], friction.coefficient)
        return cls(rows, friction.coefficient, max(_LAW_STD, used * friction.std / friction.coefficient))

    def breach(self, parameters: Floats) -> Breach:
        """Return how far parameters (7 k,) are from the law, and the slopes of that."""
        force_x, force_y, force_z, margin = parameters[self.rows].tolist()
        shear, friction = math.hypot(force_x, force_y), self.coefficient * force_z
        per_std = 1.0 / self.margin_std
        along = per_std / max(shear * friction, 1e-300)
        slopes = np.array([force_x * along, force_y * along, -shear * per_std / (friction * force_z), per_std])
        return Breach((margin - 1.0 + shear / friction) * per_std, slopes)


def used_friction(forces: Floats, coefficient: float) -> float:
    """Share of friction that forces F_x, F_y, F_z, .. use, at most 1."""
    force_x, force_y, force_z = forces[:3].tolist()
    return float(min(math.hypot(force_x, force_y) / (coefficient * max(force_z, 1e-300)), 1.0))


def add_laws(
    laws: Sequence[FrictionLaw], breaches: Sequence[Breach], gradient: Floats, precision: Floats
) -> tuple[Floats, Floats]:
    """Gradient (p,) and precision (p, p) of a chi-square with the laws, which are broken by so much."""
    gradient, precision = gradient.copy(), precision.copy()
    for law, (value, slopes) in zip(laws, breaches, strict=True):
        gradient[law.rows] -= value * slopes
        precision[law.rows, law.rows] += slopes * slopes[:, None]
    return gradient, precision


def sum_of_squares(breaches: Sequence[Breach]) -> float:
    return math.fsum(breach.value**2 for breach in breaches)


def are_linear(laws: Sequence[FrictionLaw], before: Sequence[Breach], after: Sequence[Breach], moved: Floats) -> bool:
    """Return whether breaches changed with the parameters, moved by (p,), as their slopes have it."""
    return all(
        abs(new.value - old.value - float(old.slopes @ moved[law.rows])) < _LAW_LINEAR
        for law, old, new in zip(laws, before, after, strict=True)
    )


def have_changed(before: Sequence[FrictionLaw], after: Sequence[FrictionLaw]) -> bool:
    """Return whether laws of the same contacts hold to another standard deviation."""
    return any(
        abs(new.margin_std / old.margin_std - 1.0) > _LAW_CHANGED for old, new in zip(before, after, strict=True)
    )


@dataclass(frozen=True)
class Settled:
    """Where chi-square is least."""

    parameters: Floats
    chi_square: float
    precision: Floats
    linearisation: Linearisation  # near the parameters


@dataclass(frozen=True)
class _Expansion(Expansion):
    """Chi-square about some parameters, the laws of friction included."""

    at: Linearisation


class SlipProblem:
    """Chi-square of one frame over the parameters of its contacts.

    Parameters
    ----------
    model
    frame
    friction
        Of each contact, None where it is not known.

    Attributes
    ----------
    frame
        As given.
    lawful
        Contacts, by index, whose friction is known.
    count
        Terms of chi-square.
    """

    _size = PARAMETERS
    _rounds = 5  # linearisations from the frame before

    def __init__(self, model: DiscModel, frame: Frame, friction: Sequence[Friction | None]) -> None:
        self._model = model
        self.frame = frame
        self._friction = friction
        self.lawful = frozenset(index for index, known in enumerate(friction) if known is not None)
        self.count = frame.count + len(self.lawful)

    def from_starts(self, starts: Sequence[ContactStart]) -> Settled:
        """Fit by steps of Levenberg and Marquardt, from several margins where neither margin nor friction is known."""
        begin, lower, upper = self._begin(starts)
        margins = np.array([start.slip_margin for start in starts])
        for index, known in enumerate(self._friction):
            if known is not None:
                margins[index] = 1.0 - used_friction(begin[index, FORCE_X:], known.coefficient)
        laws = self._laws(np.column_stack([begin, margins]).ravel())
        best: Settled | None = None
        for guess in _MARGIN_STARTS if np.isnan(margins).any() else (0.0,):
            start = np.column_stack([begin, np.where(np.isnan(margins), guess, margins)]).ravel()
            found = self._minimise(start, laws, lower, upper)
            if best is None or found.chi_square < best.chi_square:
                best = found
            begin = found.parameters.reshape(-1, PARAMETERS)[:, :MARGIN]  # the margin hardly moves the rest
        assert best is not None  # noqa: S101  there is at least one start
        if not laws:
            return best
        return self.from_before(best.linearisation, {}) or best  # with the law as exact as the forces found allow

    def from_parameters(self, parameters: Floats, held: Mapping[int, float]) -> Settled:
        """Fit from parameters (7 k,) by steps of Levenberg and Marquardt, margins of contacts by index held."""
        return self._minimise(parameters, self._laws(parameters), *self._bounds(parameters, held))

    def from_before(self, before: Linearisation, held: Mapping[int, float]) -> Settled | None:
        """Fit from near the minimum by Gauss-Newton steps, most often one or two; None where they do not settle.

        `held`: margins of contacts, by index, that are not fitted.
        """
        at = before
        lower, upper = self._bounds(at.parameters, held)
        laws = self._laws(at.parameters)
        if at.whitening is not self.frame.whitening:
            at = self._linearised(np.clip(at.parameters, lower, upper))
        for _ in range(self._rounds):
            chi_square, gradient = at.left(self.frame.target)
            try:
                found = _least(at, chi_square, gradient, laws, lower, upper)
                if laws and have_changed(laws, renewed := self._laws(found.parameters)):
                    laws = renewed
                    found = _least(at, chi_square, gradient, laws, lower, upper)
            except np.linalg.LinAlgError:  # what leaves no trace has no step
                return None
            off = self._off(at.parameters, found.parameters)
            if off < _NEAR and off * off * found.fall < _SETTLED**2 * max(found.chi_square / self.count, 1.0):
                return Settled(found.parameters, found.chi_square, found.precision, at)
            at = self._linearised(found.parameters)
        return None

    def chi_square(self, parameters: Floats) -> float:
        """Return the chi-square of parameters, the law of friction aside."""
        return self._linearised(parameters).left(self.frame.target)[0]

    def _linearised(self, parameters: Floats) -> Linearisation:
        return Linearisation(self._model, parameters, self.frame.whitening)

    def _minimise(self, start: Floats, laws: Sequence[FrictionLaw], lower: Floats, upper: Floats) -> Settled:
        def expand(parameters: Floats) -> _Expansion:
            at = self._linearised(parameters)
            chi_square, gradient = at.left(self.frame.target)
            breaches = [law.breach(parameters) for law in laws]
            total = chi_square + sum_of_squares(breaches)
            return _Expansion(total, *add_laws(laws, breaches, gradient, at.precision), at)

        parameters, found = minimise(expand, start, lower, upper, self.count)
        return Settled(parameters, found.chi_square, found.precision, found.at)

    def _begin(self, starts: Sequence[ContactStart]) -> tuple[Floats, Floats, Floats]:
        """Return parameters of best Hertz forces, all but the margin, (contacts, 6), and bounds of all (7 k,)."""
        poses = np.array([clipped(self._model, start) for start in starts])
        guess = np.column_stack([poses, np.tile([0.0, 0.0, 1.0, 0.0], (len(starts), 1))])
        at = Linearisation(self._model, guess.ravel(), self.frame.whitening)
        forces = (PARAMETERS * np.arange(len(starts))[:, None] + np.arange(FORCE_X, MARGIN)).ravel()
        _, gradient = at.left(self.frame.target)
        # The residual is that of a newton on each: what is to be added to it
        solution = np.linalg.lstsq(at.precision[np.ix_(forces, forces)], gradient[forces])[0].reshape(-1, 3)
        begin = np.column_stack([poses, solution + guess[:, FORCE_X:MARGIN]])
        lower, upper = self._bounds(np.column_stack([begin, np.zeros(len(starts))]).ravel(), {})
        by_contact = lower.reshape(-1, PARAMETERS), upper.reshape(-1, PARAMETERS)
        return np.clip(begin, by_contact[0][:, :MARGIN], by_contact[1][:, :MARGIN]), lower, upper

    def _bounds(self, parameters: Floats, held: Mapping[int, float]) -> tuple[Floats, Floats]:
        forces = parameters.reshape(-1, PARAMETERS)[:, FORCE_X:MARGIN]
        lowest, highest = bounds(self._model, max(forces.max(), -forces.min()))
        lower = np.array([*lowest, 0.0] * len(forces))
        upper = np.array([*highest, FULL_STICK] * len(forces))
        for index, margin in held.items():
            lower[PARAMETERS * index + MARGIN] = upper[PARAMETERS * index + MARGIN] = margin
        return lower, upper

    def _laws(self, parameters: Floats) -> list[FrictionLaw]:
        """Return the laws of friction of the contacts for which it is known."""
        return [
            FrictionLaw.of(index, known, parameters) for index, known in enumerate(self._friction) if known is not None
        ]

    def _off(self, before: Floats, found: Floats) -> float:
        """Return how far parameters are from others; 1 is a depth, the normal force, or 0.7 of the margin."""
        largest = 0.0
        depth_m = self._model.depth_m
        moved = np.abs(found - before).tolist()
        for first in range(0, len(moved), self._size):
            by_depth = max(moved[first : first + FORCE_X] + moved[first + PARAMETERS : first + self._size]) / depth_m
            by_force = max(moved[first + FORCE_X : first + MARGIN])
            by_force /= float(before[first + FORCE_Z])
            margin, margin_before = float(found[first + MARGIN]), float(before[first + MARGIN])
            by_margin = abs(margin - margin_before) / _MARGIN_SCALE
            by_margin = max(by_margin, abs(margin**_SLOPE_POWER - margin_before**_SLOPE_POWER))
            largest = max(largest, by_depth, by_force, by_margin)
        return largest


class _Least(NamedTuple):
    """Where a chi-square is least whose signals are linear."""

    parameters: Floats
    chi_square: float
    fall: float  # of chi-square, from the linearisation
    precision: Floats


def _least(
    at: Linearisation, chi_square: float, gradient: Floats, laws: Sequence[FrictionLaw], lower: Floats, upper: Floats
) -> _Least:
    """Minimise between bounds as if the signals were linear, though not the laws of friction."""
    parameters, here, precision = at.parameters, gradient, at.precision
    inside = _are_inside(parameters, lower, upper)
    if not inside:
        parameters = np.clip(parameters, lower, upper)
        here = gradient - at.precision @ (parameters - at.parameters)
    breaches = [law.breach(parameters) for law in laws]
    chi_before = chi_square + sum_of_squares(breaches)
    for _ in range(_STEPS):
        if laws:
            here, precision = add_laws(laws, breaches, here, at.precision)
        step = _free_step(here, precision) if inside else _bounded_step(parameters, lower, upper, here, precision)
        stopped = tried = parameters + step
        inside = _are_inside(tried, lower, upper)
        if not inside:
            stopped = np.clip(tried, lower, upper)
        before, breaches = breaches, [law.breach(stopped) for law in laws]
        is_least = (inside or bool((stopped == tried).all())) and are_linear(laws, before, breaches, step)
        parameters, moved = stopped, stopped - at.parameters
        curved = at.precision @ moved
        if is_least:
            break
        here = gradient - curved
    least = chi_square - float(moved @ (2.0 * gradient - curved)) + sum_of_squares(breaches)
    return _Least(parameters, least, max(chi_before - least, 0.0), precision)


def _are_inside(parameters: Floats, lower: Floats, upper: Floats) -> bool:
    """Return whether parameters lie between bounds, none of them at one."""
    triples = zip(lower.tolist(), parameters.tolist(), upper.tolist(), strict=True)
    return all(low < value < high for low, value, high in triples)


def _free_step(gradient: Floats, precision: Floats) -> Floats:
    """Return the step to the minimum; LinAlgError if the precision is not positive definite."""
    _, step, failed = lapack.dposv(precision, gradient)
    if failed:
        raise np.linalg.LinAlgError("precision is not positive definite")
    return np.asarray(step, np.float64)


def _bounded_step(parameters: Floats, lower: Floats, upper: Floats, gradient: Floats, precision: Floats) -> Floats:
    """Return the step to the minimum among the parameters that do not press against a bound."""
    stuck = ((parameters <= lower) & (gradient <= 0.0)) | ((parameters >= upper) & (gradient >= 0.0))
    free = np.flatnonzero(~stuck & (lower < upper))
    step = np.zeros_like(parameters)
    step[free] = np.linalg.solve(precision[free[:, None], free], gradient[free])
    return step
