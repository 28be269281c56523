"""Slip of contacts: fits of a single frame, of frames that follow each other, and events as slip sets in."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.decoded import KNOWN_LIMIT, SIGNAL_LIMIT
from resonator_daemon.estimate.surface.fitting.contact_fit import Fit
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import (
    MARGIN_STD_LIMIT,
    ContactStart,
    Friction,
    PartialSlip,
    describe,
    nothing_known,
)
from resonator_daemon.estimate.surface.fitting.slip_problem import (
    FULL_STICK,
    Frame,
    Linearisation,
    Settled,
    SlipProblem,
    Whitening,
)
from resonator_daemon.estimate.surface.fitting.slip_signals import FORCE_Z, MARGIN, PARAMETERS
from resonator_daemon.estimate.surface.fitting.systematic import Offset, offset_of, systematic_covariances
from resonator_daemon.estimate.surface.skin import Skin

_ANY_MARGIN_PRECISION = 12.0  # of one that may be anything between 0 and 1
_RELEASE_STD = 0.15  # of a margin that was held because it left no trace: from then on it is fitted
_RIVAL_DISTANCE = 0.3  # from the best margin, where another that fits ...
_RIVAL_STD = 3.0  # ... within so many standard deviations leaves it unknown
_CERTAIN_STD = 0.025  # of a margin, within which there is no rival ...
_CERTAIN_MARGIN = 0.8  # ... unless it is above this: near full stick errors are far from Gaussian
_RIVAL_MOVE = 0.1  # of the margin, within which the rival of the frame before is a good beginning

_RENEWED = 8  # frames after which systematic covariances are computed again ...
_FORCE_CHANGE = 0.05  # ... or sooner, where a force has changed by this share

INCIPIENT_MARGIN = 0.3  # below it slip is announced ...
REARM_MARGIN = 0.4  # ... and above this, it may be announced again
_IN_A_ROW = 2  # frames that must agree on an event: one may be noise
_GROSS_MARGIN = 0.1  # where a margin that may be 0 is taken as 0
_SIGNIFICANCE = 2.0  # standard deviations
_KNOWN = 0.1  # relative standard deviation at which a coefficient begins to count as known
_KNOWN_FLOOR = 0.03  # relative standard deviation to which frames can bring it; friction changes, and models are wrong


def fit_partial_slip(
    model: DiscModel, signals: ArrayLike, noise_std: ArrayLike, starts: Sequence[ContactStart]
) -> list[PartialSlip]:
    """Fit contacts to one frame, all at once, each in the field of the others.

    Parameters
    ----------
    model
        With the Hertz profile.
    signals
        [3 p_n / (2 E), eps_xz, eps_yz], (3, n); one that is NaN, infinite or beyond 10 counts as lost.
    noise_std
        Broadcastable to (3, n).
    starts
        One for each contact.

    Raises
    ------
    ValueError
        No start or one that is not finite, a shape that does not fit, fewer sites than unknowns, noise not above 0.
    """
    return list(SlipFitter(model).fit(signals, noise_std, dict(enumerate(starts))).values())


class SlipFitter:
    """Sequential fit of contacts to frames, each from where the fit of the frame before ended.

    As long as contacts stay the same, a frame costs one evaluation of the signals and their slopes, and none at rest.

    Parameters
    ----------
    model
        With the Hertz profile.
    skin
        Whose uncertainty contacts state; None: it has none.
    offset_std
        Noise of the signals without gain errors, (3, n); None: no signals have a common offset.

    Attributes
    ----------
    offset
        That the last frame has; None without a fit.
    """

    def __init__(self, model: DiscModel, skin: Skin | None = None, offset_std: Floats | None = None) -> None:
        self._model = model
        self._skin = skin
        self._offset_std = offset_std
        self.offset: Offset | None = None
        self._whitening: Whitening | None = None
        self._reset()

    def _reset(self) -> None:
        self._contacts: list[int] = []
        self._systematic: tuple[Floats, int, Floats] = np.zeros(0), 0, np.zeros(0)  # with forces and age in frames
        self._before: Linearisation | None = None
        self._unknown: set[int] = set()  # contacts, by index, whose margin was not known
        self._held: dict[int, float] = {}  # margins that left no trace
        self._rivals: dict[tuple[int, float], Linearisation] = {}  # by contact and distance of the margin

    def fit(
        self, signals: ArrayLike, noise_std: ArrayLike, starts: Mapping[int, ContactStart]
    ) -> dict[int, PartialSlip]:
        """Fit a frame; returns results by the ids of the contacts.

        `starts` serve where there is no frame before, or it leads nowhere. Other arguments and errors as of
        `fit_partial_slip`.
        """
        self.offset = None
        frame = self._checked(signals, noise_std, len(starts))
        self._whitening = frame.whitening
        needed = max(KNOWN_LIMIT * frame.target.size, PARAMETERS * len(starts))
        if frame.count < needed:
            self._reset()
            text = f"{frame.count} signals known (finite, within {SIGNAL_LIMIT}), needs {needed:.0f}"
            return {contact: nothing_known(np.nan, Reason(ReasonCode.SIGNALS_MISSING, text)) for contact in starts}
        problem = SlipProblem(self._model, frame, [start.friction for start in starts.values()])
        found = self._followed(problem) if self._contacts == list(starts) else None
        if found is None:
            self._reset()
            found, _ = self._described(problem, problem.from_starts(list(starts.values())), {})
        self._contacts = list(starts)
        if any(math.isnan(slip.radius_m) for slip in found):
            self._reset()
        return dict(zip(starts, found, strict=True))

    def _checked(self, signals: ArrayLike, noise_std: ArrayLike, contacts: int) -> Frame:
        frame, count = np.asarray(signals, np.float64), len(self._model.sites_m)
        if frame.shape != (3, count):
            raise ValueError(f"signals have shape {frame.shape}, must be (3, {count})")
        if not contacts:
            raise ValueError("starts is empty, must name at least one contact")
        if 3 * count < PARAMETERS * contacts:
            raise ValueError(
                f"{count} sites make {3 * count} signals, must be at least 7 for each of {contacts} contacts"
            )
        return Frame(self._model, frame, np.asarray(noise_std, np.float64), self._whitening)

    def _followed(self, problem: SlipProblem) -> list[PartialSlip] | None:
        """Fit from the frame before; None where a fit from the starts is due.

        That is where the fit does not settle, where another margin fits better, and where a margin becomes known.
        """
        if self._before is None:
            return None
        held = {index: margin for index, margin in self._held.items() if index not in problem.lawful}
        unknown = self._unknown - problem.lawful
        settled = problem.from_before(self._before, held)
        if settled is None:
            return None
        found, is_best = self._described(problem, settled, held)
        return found if is_best and unknown <= self._unknown else None

    def _described(
        self, problem: SlipProblem, settled: Settled, held: Mapping[int, float]
    ) -> tuple[list[PartialSlip], bool]:
        """Describe contacts and keep what the next frame needs; returns also whether no other margin fits better.

        `held`: margins of contacts, by index, that were not fitted.
        """
        self.offset = None
        frame, parameters, precision = problem.frame, settled.parameters, settled.precision.copy()
        margins = np.arange(MARGIN, parameters.size, PARAMETERS)
        precision[margins, margins] += _ANY_MARGIN_PRECISION
        fit = Fit(parameters, precision, settled.chi_square, problem.count, frame.energy)
        covariance, rivals, is_best = fit.covariance, self._rivals, True
        of_noise = covariance / max(fit.chi2, 1.0)
        systematic = self._systematic_covariances(settled, of_noise)
        if self._offset_std is not None and np.isfinite(of_noise).all():
            self.offset = offset_of(frame, settled, of_noise, self._offset_std)
            by_contact = self.offset.moved.reshape(-1, PARAMETERS, 3)
            systematic = systematic + by_contact @ by_contact.transpose(0, 2, 1)
        self._before, self._rivals, self._held, self._unknown = settled.linearisation, {}, {}, set()
        found = []
        for index, place in enumerate(margins.tolist()):
            rows = slice(place - MARGIN, place + 1)
            margin, margin_std = float(parameters[place]), math.sqrt(covariance[place, place])
            if index not in problem.lawful:
                if margin_std > (_RELEASE_STD if index in held else MARGIN_STD_LIMIT):
                    self._held[index] = margin
                    self._unknown.add(index)
                elif index in held:
                    is_best = False
                elif margin_std > _CERTAIN_STD or margin > _CERTAIN_MARGIN:
                    worse = self._rival(problem, settled, index, held, rivals) - settled.chi_square
                    is_best = is_best and worse > 0.0
                    if worse < _RIVAL_STD**2 * max(fit.chi2, 1.0):
                        self._unknown.add(index)
            is_known = index not in self._unknown
            covariances = covariance[rows, rows], systematic[index]
            found.append(describe(fit, parameters[rows], *covariances, self._model.radius_max_m, margin_known=is_known))
        return found, is_best

    def _systematic_covariances(self, settled: Settled, covariance: Floats) -> Floats:
        """Return the systematic covariances of a frame, or of one a moment ago if no force has changed since."""
        if self._skin is None or not np.isfinite(covariance).all():
            return np.zeros((len(covariance) // PARAMETERS, PARAMETERS, PARAMETERS))
        forces = settled.parameters[FORCE_Z::PARAMETERS]
        before, age, found = self._systematic
        if forces.shape != before.shape or age > _RENEWED or np.abs(forces / before - 1.0).max() > _FORCE_CHANGE:
            before, age = forces, 0
            found = systematic_covariances(self._skin, settled.linearisation, covariance)
        self._systematic = before, age + 1, found
        return found

    def _rival(
        self,
        problem: SlipProblem,
        best: Settled,
        index: int,
        held: Mapping[int, float],
        before: Mapping[tuple[int, float], Linearisation],
    ) -> float:
        """Least chi-square with a margin far off the best one of a contact."""
        chi_squares = [np.inf]
        for distance in (_RIVAL_DISTANCE, -_RIVAL_DISTANCE):
            place = PARAMETERS * index + MARGIN
            margin = float(best.parameters[place]) + distance
            if not 0.0 <= margin <= FULL_STICK:
                continue
            begin = before.get((index, distance))
            if begin is None or abs(float(begin.parameters[place]) - margin) > _RIVAL_MOVE:
                begin = best.linearisation
            rival = problem.from_before(begin, {**held, index: margin})
            if rival is None:
                rival = problem.from_parameters(best.parameters, {**held, index: margin})
            self._rivals[index, distance] = rival.linearisation
            chi_squares.append(rival.chi_square)
        return min(chi_squares)


@dataclass(frozen=True)
class SlipEvent:
    """A contact begins to slip at its rim, or slips as a whole."""

    event: Literal["incipient_slip", "gross_slip"]
    contact: int  # its id
    slip: PartialSlip  # of the frame that shows it


@dataclass
class _Followed:
    start: ContactStart
    low: int = 0  # frames in a row with little margin
    none: int = 0  # frames in a row with none
    announced: set[str] = field(default_factory=set)


class SlipWatch:
    """Slip monitor that fits each contact in each frame, from where it was in the frame before.

    While nothing is known of friction, a contact that slips at its rim determines mu by its stick radius. From then on
    mu is carried from frame to frame, contact by contact, and forces add their information.

    Parameters
    ----------
    model
        With the Hertz profile.
    friction
        What is known of it beforehand.
    skin, offset_std, offset
        As of `SlipFitter`.
    """

    def __init__(
        self,
        model: DiscModel,
        friction: Friction | None = None,
        skin: Skin | None = None,
        offset_std: Floats | None = None,
    ) -> None:
        self._fitter = SlipFitter(model, skin, offset_std)
        self._friction = friction
        self._followed: dict[int, _Followed] = {}

    @property
    def offset(self) -> Offset | None:
        return self._fitter.offset

    def update(
        self, signals: ArrayLike, noise_std: ArrayLike, contacts: Mapping[int, ContactStart]
    ) -> dict[int, PartialSlip]:
        """Fit a frame; return fits by the ids of `contacts`.

        A contact is identified by its id; the start it comes with serves while the frame before gives no better. One
        that is absent is discarded. Arguments otherwise and errors as of `fit_partial_slip`.
        """
        for gone in self._followed.keys() - contacts.keys():
            del self._followed[gone]
        for contact, start in contacts.items():
            if contact not in self._followed:
                self._followed[contact] = _Followed(replace(start, friction=start.friction or self._friction))
            elif not np.isfinite(self._followed[contact].start.radius_m):
                self._followed[contact].start = replace(start, friction=self._followed[contact].start.friction)
        if not contacts:
            return {}
        starts = {contact: self._followed[contact].start for contact in contacts}
        fits = self._fitter.fit(signals, noise_std, starts)
        for contact, slip in fits.items():
            followed = self._followed[contact]
            followed.start = ContactStart(
                (float(slip.centre_m[0]), float(slip.centre_m[1])),
                slip.radius_m,
                slip.slip_margin,
                _updated_friction(followed.start.friction, slip),
            )
        return fits

    def announce(self, slips: Mapping[int, PartialSlip]) -> tuple[SlipEvent, ...]:
        """Return the events of contacts in the last frame, by their fits or better ones.

        An event comes once, and again only after the margin has exceeded 0.4.
        """
        return tuple(
            SlipEvent(event, contact, slip)
            for contact, slip in slips.items()
            for event in _announce(self._followed[contact], slip)
        )


def _updated_friction(before: Friction | None, slip: PartialSlip) -> Friction | None:
    """Return the friction after a frame; the fit has weighed what was known before."""
    mu, std = slip.friction_coefficient, slip.friction_coefficient_std
    if not std < (before.std if before else _KNOWN * mu):  # also where they are not known
        return before
    return Friction(mu, max(std, _KNOWN_FLOOR * mu))


def _announce(followed: _Followed, slip: PartialSlip) -> list[Literal["incipient_slip", "gross_slip"]]:
    margin = slip.slip_margin
    if np.isnan(margin):
        return []
    if margin > REARM_MARGIN:
        followed.announced.clear()
    followed.low = followed.low + 1 if margin < INCIPIENT_MARGIN else 0
    gone = margin < min(_SIGNIFICANCE * slip.slip_margin_std, _GROSS_MARGIN)
    followed.none = followed.none + 1 if gone else 0
    events: list[Literal["incipient_slip", "gross_slip"]] = []
    if followed.low >= _IN_A_ROW and "incipient_slip" not in followed.announced:
        events.append("incipient_slip")
    if followed.none >= _IN_A_ROW and "gross_slip" not in followed.announced:
        events.append("gross_slip")
    followed.announced.update(events)
    return events
