"""Least squares of contacts in partial slip in one frame, from nothing and from where the frame before ended.

Parameters are x, y, a, F_x, F_y, F_z, m of each contact, one after the other. Beside the signals, chi-square has one
term for each contact whose friction is known: by how much it breaks m = 1 - F_t / (mu F_z).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.decoding.fitting.contact_fit import bounded_step, minimise
from resonator_daemon.decoding.fitting.contact_model import DiscModel
from resonator_daemon.decoding.fitting.contact_start import ContactStart, Friction, bounds, clipped
from resonator_daemon.decoding.fitting.slip_signals import PARAMETERS, Singles, rows_of
from resonator_daemon.decoding.parameters import SIGNAL_LIMIT

Floats = NDArray[np.float64]
Known = NDArray[np.bool_]

X, Y, RADIUS, FORCE_X, FORCE_Y, FORCE_Z, MARGIN = range(PARAMETERS)
FULL_STICK = 1.0 - 1e-4  # above it the margin leaves no trace in the signals, and 1 - m no digits
_MARGIN_STARTS = (0.15, 0.6)  # of which one leads to the least chi-square
_FRICTION_LAW_STD = 1e-3  # of the margin, to which the law of friction is held where mu is exact
_DAMPING = 1e-9  # of steps without damping, so that what leaves no trace stays as it is
_STEPS = 6  # between bounds, of one linearisation
_LAW_SETTLED = 0.05  # standard deviations of the law of friction
_LAW_CHANGE = 0.03  # relative, of its standard deviation, which forces decide
_ROUNDS = 5  # linearisations from the frame before
_NEAR = 0.03  # of depth, force or margin: within it slopes are those of the linearisation ...
_MARGIN_SCALE = 0.7  # of the margin, as a depth is one of length; near 0 ...
_SLOPE_POWER = 2.0 / 3.0  # ... slopes go with this power of it
_SETTLED = 0.12  # standard deviations


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

    def __init__(self, model: DiscModel, known: Known, noise_std: Floats) -> None:
        if not (noise_std > 0.0).all():
            raise ValueError(f"noise_std reaches {noise_std.min()}, must be above 0")
        self._known, self._noise_std = known, noise_std
        self.weights: Floats = np.where(known, 1.0 / noise_std, 0.0)
        self.factors = model.slip.whiten(self.weights)

    def serves(self, known: Known, noise_std: Floats) -> bool:
        """Whether the weights are those of other signals, too."""
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
        known: Known = np.abs(signals) <= SIGNAL_LIMIT  # False for NaN
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

    def __init__(self, model: DiscModel, parameters: Floats, whitening: Whitening) -> None:
        self.parameters = parameters
        self.whitening = whitening
        whiten = whitening.factors
        contacts = parameters.reshape(-1, PARAMETERS)
        self._slopes = np.empty((parameters.size, whiten.size), np.float32)
        self._rows = rows_of(len(contacts))
        filled = [
            model.slip.fill(contact, whiten, self._slopes[PARAMETERS * index : PARAMETERS * (index + 1)])
            for index, contact in enumerate(contacts)
        ]
        self._value = filled[0][0] if len(filled) == 1 else np.sum([value for value, _ in filled], axis=0)
        self._scale = filled[0][1] if len(filled) == 1 else np.concatenate([scale for _, scale in filled])
        product = (self._slopes @ self._slopes.T).astype(np.float64)
        self.precision = product[self._rows[:, None], self._rows] * np.outer(self._scale, self._scale)

    def left(self, target: Singles) -> tuple[float, Floats]:
        """Chi-square of signals (3 n,) and its gradient (7 k,) at the parameters, without the law of friction."""
        residual = target - self._value
        gradient = (self._slopes @ residual)[self._rows].astype(np.float64) * self._scale
        return float(residual @ residual), gradient


@dataclass(frozen=True)
class Law:
    """Friction of one contact, whose coefficient is known."""

    index: int  # of the contact's first parameter
    coefficient: float
    margin_std: float  # to which margin and forces must agree

    def breach(self, parameters: Floats) -> tuple[float, Floats]:
        """Return m - 1 + F_t / (mu F_z) in standard deviations, and its slopes by F_x, F_y, F_z, m."""
        force_x, force_y, force_z, margin = parameters[self.index + FORCE_X : self.index + PARAMETERS].tolist()
        shear, friction = math.hypot(force_x, force_y), self.coefficient * force_z
        per_shear = 1.0 / max(shear * friction, 1e-300)
        slopes = np.array([force_x * per_shear, force_y * per_shear, -shear / (friction * force_z), 1.0])
        return (margin - 1.0 + shear / friction) / self.margin_std, slopes / self.margin_std


@dataclass(frozen=True)
class Expansion:
    """Chi-square about some parameters, the law of friction included."""

    chi_square: float
    gradient: Floats
    precision: Floats


@dataclass(frozen=True)
class Settled:
    """Where chi-square is least."""

    parameters: Floats
    chi_square: float
    precision: Floats
    linearisation: Linearisation  # near the parameters


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
                margins[index] = 1.0 - _used(begin[index], known.coefficient)
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
        """Fit from near the minimum by Gauss-Newton steps, most often one or none; None where they do not settle.

        `held`: margins of contacts, by index, that are not fitted.
        """
        at = before
        lower, upper = self._bounds(at.parameters, held)
        laws = self._laws(at.parameters)
        if at.whitening is not self.frame.whitening:
            at = Linearisation(self._model, np.clip(at.parameters, lower, upper), self.frame.whitening)
        for _ in range(_ROUNDS):
            chi_square, gradient = at.left(self.frame.target)
            found, least, precision = _least(at, chi_square, gradient, laws, lower, upper)
            renewed = self._laws(found)
            if any(
                abs(new.margin_std / law.margin_std - 1.0) > _LAW_CHANGE for new, law in zip(renewed, laws, strict=True)
            ):
                laws = renewed
                found, least, precision = _least(at, chi_square, gradient, laws, lower, upper)
            off = self._off(at.parameters, found)
            excess = max(least / self.count, 1.0)
            fall = max(_with_laws(chi_square, laws, at.parameters) - least, 0.0)
            if off < _NEAR and off * off * fall < _SETTLED**2 * excess:
                return Settled(found, least, precision, at)
            at = Linearisation(self._model, found, self.frame.whitening)
        return None

    def _minimise(self, start: Floats, laws: Sequence[Law], lower: Floats, upper: Floats) -> Settled:
        @dataclass(frozen=True)
        class Here(Expansion):
            at: Linearisation

        def expand(parameters: Floats) -> Here:
            at = Linearisation(self._model, parameters, self.frame.whitening)
            chi_square, gradient = at.left(self.frame.target)
            return Here(*_lawful(chi_square, gradient, at.precision, laws, parameters), at)

        parameters, found = minimise(expand, start, lower, upper, self.count)
        return Settled(parameters, found.chi_square, found.precision, found.at)

    def _begin(self, starts: Sequence[ContactStart]) -> tuple[Floats, Floats, Floats]:
        """Parameters of each contact but the margin, (contacts, 6), and bounds of all (7 k,): of best Hertz forces."""
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
        contacts = parameters.reshape(-1, PARAMETERS)
        lower, upper = bounds(self._model, float(np.abs(contacts[:, FORCE_X:MARGIN]).max()))
        lower, upper = (np.tile(np.append(*pair), len(contacts)) for pair in ((lower, 0.0), (upper, FULL_STICK)))
        for index, margin in held.items():
            lower[PARAMETERS * index + MARGIN] = upper[PARAMETERS * index + MARGIN] = margin
        return lower, upper

    def _laws(self, parameters: Floats) -> list[Law]:
        """Friction of the contacts for which it is known; the more of it forces use, the less exact it is."""
        laws = []
        for index, known in enumerate(self._friction):
            if known is not None:
                used = _used(parameters[PARAMETERS * index :], known.coefficient)
                std = max(_FRICTION_LAW_STD, used * known.std / known.coefficient)
                laws.append(Law(PARAMETERS * index, known.coefficient, std))
        return laws

    def _off(self, before: Floats, found: Floats) -> float:
        """Return how far parameters are from others; 1 is a depth, the normal force, or 0.7 of the margin."""
        largest = 0.0
        depth_m = float(self._model.depth_m.min())
        moved = (found - before).tolist()
        for first in range(0, len(moved), PARAMETERS):
            by_depth = max(abs(part) for part in moved[first : first + FORCE_X]) / depth_m
            by_force = max(abs(part) for part in moved[first + FORCE_X : first + MARGIN])
            by_force /= float(before[first + FORCE_Z])
            margin, margin_before = float(found[first + MARGIN]), float(before[first + MARGIN])
            by_margin = abs(margin - margin_before) / _MARGIN_SCALE
            by_margin = max(by_margin, abs(margin**_SLOPE_POWER - margin_before**_SLOPE_POWER))
            largest = max(largest, by_depth, by_force, by_margin)
        return largest


def _used(contact: Floats, coefficient: float) -> float:
    """Share of friction that a contact's forces use, at most 1."""
    force_x, force_y, force_z = contact[FORCE_X:MARGIN].tolist()
    return float(min(math.hypot(force_x, force_y) / (coefficient * max(force_z, 1e-300)), 1.0))


def _with_laws(chi_square: float, laws: Sequence[Law], parameters: Floats) -> float:
    return chi_square + math.fsum(law.breach(parameters)[0] ** 2 for law in laws)


def _lawful(
    chi_square: float, gradient: Floats, precision: Floats, laws: Sequence[Law], parameters: Floats
) -> tuple[float, Floats, Floats]:
    """Add the law of friction at some parameters."""
    if not laws:
        return chi_square, gradient, precision
    gradient, precision = gradient.copy(), precision.copy()
    for law in laws:
        breach, slopes = law.breach(parameters)
        rows = slice(law.index + FORCE_X, law.index + PARAMETERS)
        chi_square += breach**2
        gradient[rows] -= breach * slopes
        precision[rows, rows] += np.outer(slopes, slopes)
    return chi_square, gradient, precision


def _least(
    at: Linearisation, chi_square: float, gradient: Floats, laws: Sequence[Law], lower: Floats, upper: Floats
) -> tuple[Floats, float, Floats]:
    """Minimise between bounds as if the signals were linear; returns parameters, chi-square and precision there."""
    start, parameters = at.parameters, np.clip(at.parameters, lower, upper)
    for _ in range(_STEPS):
        moved = parameters - start
        _, here, precision = _lawful(0.0, gradient - at.precision @ moved, at.precision, laws, parameters)
        tried = parameters + bounded_step(parameters, lower, upper, here, precision, _DAMPING)
        stopped = np.clip(tried, lower, upper)
        expected = [law.breach(parameters) for law in laws]
        stepped = stopped - parameters
        parameters = stopped
        lawful = all(
            abs(law.breach(stopped)[0] - breach - slopes @ stepped[law.index + FORCE_X : law.index + PARAMETERS])
            < _LAW_SETTLED
            for law, (breach, slopes) in zip(laws, expected, strict=True)
        )
        if lawful and (stopped == tried).all():
            break
    moved = parameters - start
    least = chi_square - float(moved @ (2.0 * gradient - at.precision @ moved))
    least, _, precision = _lawful(least, gradient, at.precision, laws, parameters)
    return parameters, least, precision
