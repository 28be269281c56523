"""Contact that sticks in its middle and slips at its rim, fitted to the signals of one frame.

A paraboloid that presses with F_n and is sheared with F_t < mu F_n sticks within c of the centre of a contact of radius
a (Cattaneo 1938, Mindlin 1949; Johnson, Contact Mechanics, 1985, section 7.2). With h_a the Hertz distribution of unit
force on radius a, and the margin to slip m = 1 - F_t / (mu F_n) = (c / a)^3,

    f_z = F_n h_a,    f_t = F_t [ h_a + m / (1 - m) (h_a - h_c) ],

so that a frame tells m by itself; where mu is known, the forces tell it, too, and better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from resonator_daemon.decoding.fitting.contact_fit import Fit, fit
from resonator_daemon.decoding.fitting.contact_model import DiscModel
from resonator_daemon.decoding.fitting.contact_start import ContactStart, disc_starts
from resonator_daemon.decoding.parameters import KNOWN_LIMIT, SIGNAL_LIMIT

Floats = NDArray[np.float64]

X, Y, RADIUS, FORCE_X, FORCE_Y, FORCE_Z, MARGIN = range(7)
_FULL_STICK = 1.0 - 1e-4  # above it the margin leaves no trace in the signals, and 1 - m no digits
_MARGIN_STARTS = (0.15, 0.6)  # of which one leads to the least chi-square
_FORCE_SIGNIFICANCE = 5.0  # standard deviations of a normal force
_ANY_MARGIN_STD = 12.0**-0.5  # of one that may be anything between 0 and 1
_MARGIN_STD_LIMIT = 0.2  # beyond it a margin is not known
_RIVAL_DISTANCE = 0.3  # from the best margin, where another that fits ...
_RIVAL_STD = 3.0  # ... within so many standard deviations leaves it unknown
_FRICTION_LAW_STD = 1e-3  # of the margin, to which the law of friction is held where mu is exact


@dataclass(frozen=True)
class PartialSlip:
    """One contact in one frame. What is not known is NaN, and `reason` says why."""

    centre_m: Floats  # (2,)
    centre_std_m: Floats
    radius_m: float
    radius_std_m: float
    force_newton: Floats  # (3,)
    force_std_newton: Floats
    slip_margin: float
    slip_margin_std: float
    stick_ratio: float  # c / a
    stick_ratio_std: float
    friction_coefficient: float  # as forces and stick radius of this frame tell, and what was known before
    friction_coefficient_std: float
    covariance: Floats  # (7, 7) of x, y, a, F_x, F_y, F_z, m
    chi2: float
    log_evidence: float  # of all contacts of the frame together, less a constant
    status: str  # "ok"; "unknown" where the margin is
    reason: str


def fit_partial_slip(
    model: DiscModel,
    signals: ArrayLike,
    noise_std: ArrayLike,
    starts: Sequence[ContactStart],
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
    frame = np.asarray(signals, np.float64)
    count = len(model.sites_m)
    if frame.shape != (3, count):
        raise ValueError(f"signals have shape {frame.shape}, must be (3, {count})")
    if not starts:
        raise ValueError("starts is empty, must name at least one contact")
    if 3 * count < 7 * len(starts):
        raise ValueError(
            f"{count} sites make {3 * count} signals, must be at least 7 for each of {len(starts)} contacts"
        )
    noise = np.broadcast_to(np.asarray(noise_std, np.float64), (3, count)).ravel()
    sound = np.where(np.abs(frame) <= SIGNAL_LIMIT, frame, np.nan).ravel()
    known = int(np.isfinite(sound).sum())
    needed = max(KNOWN_LIMIT * frame.size, 7 * len(starts))
    if known < needed:
        reason = f"{known} signals known (finite, within {SIGNAL_LIMIT}), needs {needed:.0f}"
        return [_unknown(np.nan, np.nan, reason) for _ in starts]
    problem = _Problem(model, starts, sound, noise)
    found = problem.solve()
    return [problem.describe(found, index) for index in range(len(starts))]


def partial_slip_signals(model: DiscModel, contact: Floats) -> tuple[Floats, Floats]:
    """Signals (3 n,) of a contact with parameters x, y, a, F_x, F_y, F_z, m, and their slopes (7, 3 n)."""
    radius, force, shear, margin = (
        float(contact[RADIUS]),
        contact[FORCE_X:MARGIN],
        contact[FORCE_X:FORCE_Z],
        float(contact[MARGIN]),
    )
    ratio = margin ** (1.0 / 3.0)
    disc = model.signals(contact[:RADIUS], radius)
    stick = model.signals(contact[:RADIUS], radius * ratio)
    whole = disc.value.reshape(3, -1)
    rest = (disc.value[:2] - stick.value[:2]).reshape(2, -1)  # of unit shear, h_a - h_c
    excess = margin / (1.0 - margin)
    slopes = np.empty((7, whole.shape[1]))
    for index, of_disc, of_stick in (
        (X, disc.by_x, stick.by_x),
        (Y, disc.by_y, stick.by_y),
        (RADIUS, disc.by_radius, ratio * stick.by_radius),
    ):
        slopes[index] = force @ of_disc.reshape(3, -1)
        slopes[index] += (excess * shear) @ (of_disc[:2] - of_stick[:2]).reshape(2, -1)
    slopes[FORCE_X:MARGIN] = whole
    slopes[FORCE_X:FORCE_Z] += excess * rest
    slopes[MARGIN] = (shear / (1.0 - margin) ** 2) @ rest
    slopes[MARGIN] -= (radius * ratio / (3.0 * (1.0 - margin)) * shear) @ stick.by_radius[:2].reshape(2, -1)
    return force @ whole + (excess * shear) @ rest, slopes


class _Problem:
    """Signals of several contacts as a function of their parameters, then by how much each breaks the law of friction.

    Parameters of a contact are x, y, a, F_x, F_y, F_z, m.
    """

    def __init__(self, model: DiscModel, starts: Sequence[ContactStart], signals: Floats, noise_std: Floats) -> None:
        self._model = model
        self._lawful = np.array([i for i, start in enumerate(starts) if start.friction], np.intp)  # whose mu is known
        friction = [start.friction for start in starts if start.friction]
        self._mu = np.array([known.coefficient for known in friction])

        begin, lower, upper = disc_starts(model, starts, signals, noise_std)
        self._lower = np.tile(np.append(lower, 0.0), len(starts))
        self._upper = np.tile(np.append(upper, _FULL_STICK), len(starts))
        margins = np.array([start.slip_margin for start in starts])
        forces = begin[self._lawful, FORCE_X:]
        sheared = np.hypot(forces[:, 0], forces[:, 1]) / np.maximum(forces[:, 2], lower[FORCE_Z])
        margins[self._lawful] = 1.0 - np.minimum(sheared / self._mu, 1.0)
        self._start = np.column_stack([begin, margins])
        relative_std = np.array([known.std for known in friction]) / self._mu
        law_std = np.maximum(_FRICTION_LAW_STD, (1.0 - margins[self._lawful]) * relative_std)
        self._target = np.concatenate([signals, np.zeros(law_std.size)])
        self._target_std = np.concatenate([noise_std, law_std])

    def solve(self) -> Fit:
        fits = []
        for guess in _MARGIN_STARTS if np.isnan(self._start).any() else (0.0,):
            start = np.where(np.isnan(self._start), guess, self._start).ravel()
            fits.append(fit(self, start, self._lower, self._upper, self._target, self._target_std))
        return min(fits, key=lambda found: found.chi_square)

    def describe(self, found: Fit, index: int) -> PartialSlip:
        rows = slice(7 * index, 7 * index + 7)
        one, precision = found.parameters[rows], found.precision.copy()
        margins = np.arange(MARGIN, found.parameters.size, 7)
        precision[margins, margins] += _ANY_MARGIN_STD**-2
        covariance = replace(found, precision=precision).covariance[rows, rows]
        reason = _doubt(found, one, covariance, self._model)
        if reason:
            return _unknown(found.chi2, found.log_evidence, reason)
        std = np.sqrt(np.diag(covariance))
        margin, margin_std = float(one[MARGIN]), float(std[MARGIN])
        slip = (margin, margin_std, *stick_ratio(margin, margin_std), *_friction(one, covariance))
        status = "ok"
        if margin_std > _MARGIN_STD_LIMIT or (index not in self._lawful and self._has_rival(found, index)):
            slip = (np.nan,) * 6
            status, reason = "unknown", "the contact slips too little to show in the signals"
        return PartialSlip(
            one[:RADIUS],
            std[:RADIUS],
            float(one[RADIUS]),
            float(std[RADIUS]),
            one[FORCE_X:MARGIN],
            std[FORCE_X:MARGIN],
            *slip,
            covariance,
            found.chi2,
            found.log_evidence,
            status,
            reason,
        )

    def _has_rival(self, found: Fit, index: int) -> bool:
        """Whether a margin far off fits nearly as well: near full stick its error is far from a Gaussian one."""
        place = 7 * index + MARGIN
        limit = found.chi_square + _RIVAL_STD**2 * max(found.chi2, 1.0)
        for rival in found.parameters[place] + np.array([_RIVAL_DISTANCE, -_RIVAL_DISTANCE]):
            if 0.0 <= rival <= _FULL_STICK:
                lower, upper, start = self._lower.copy(), self._upper.copy(), found.parameters.copy()
                lower[place] = upper[place] = start[place] = rival
                if fit(self, start, lower, upper, self._target, self._target_std).chi_square < limit:
                    return True
        return False

    def __call__(self, parameters: Floats) -> tuple[Floats, Floats]:
        """Signals (3 n,) and breaches (contacts,) in one row, and slopes (parameters, as many)."""
        contacts = parameters.reshape(-1, 7)
        values, slopes = zip(*(partial_slip_signals(self._model, one) for one in contacts), strict=True)
        lawful = contacts[self._lawful]
        shear, friction = np.hypot(lawful[:, FORCE_X], lawful[:, FORCE_Y]), self._mu * lawful[:, FORCE_Z]
        breach = lawful[:, MARGIN] - 1.0 + shear / friction
        of_breach = np.zeros((*contacts.shape, breach.size))
        of_breach[self._lawful, FORCE_X:FORCE_Z, np.arange(breach.size)] = (
            lawful[:, FORCE_X:FORCE_Z] / np.maximum(shear * friction, np.finfo(np.float64).tiny)[:, None]
        )
        of_breach[self._lawful, FORCE_Z, np.arange(breach.size)] = -shear / friction / lawful[:, FORCE_Z]
        of_breach[self._lawful, MARGIN, np.arange(breach.size)] = 1.0
        value = np.concatenate([np.sum(values, axis=0), breach])
        return value, np.hstack([np.concatenate(slopes), of_breach.reshape(contacts.size, breach.size)])


def _unknown(chi2: float, log_evidence: float, reason: str) -> PartialSlip:
    two, three = np.full(2, np.nan), np.full(3, np.nan)
    nothing = (np.nan,) * 6
    covariance = np.full((7, 7), np.nan)
    return PartialSlip(
        two, two, np.nan, np.nan, three, three, *nothing, covariance, chi2, log_evidence, "unknown", reason
    )


def _doubt(found: Fit, one: Floats, covariance: Floats, model: DiscModel) -> str:
    """Why nothing is known of a contact; empty where something is."""
    if not np.isfinite(covariance).all():
        return "the signals do not determine the contact"
    if found.doubt:
        return found.doubt
    if one[FORCE_Z] < _FORCE_SIGNIFICANCE * np.sqrt(covariance[FORCE_Z, FORCE_Z]):
        return f"the normal force is below {_FORCE_SIGNIFICANCE:g} standard deviations"
    if one[RADIUS] >= model.radius_max_m:
        return f"the contact is larger than {model.radius_max_m} m in radius"
    return ""


def stick_ratio(slip_margin: float, slip_margin_std: float) -> tuple[float, float]:
    """Return c / a = m^(1/3) and its standard deviation: by the ends of the margin's: the root is steep at 0."""
    middle, lower, upper = np.cbrt(
        np.clip([slip_margin, slip_margin - slip_margin_std, slip_margin + slip_margin_std], 0.0, 1.0)
    )
    return float(middle), float(upper - lower) / 2.0


def _friction(one: Floats, covariance: Floats) -> tuple[float, float]:
    """Mu = F_t / (F_n (1 - m)), and its standard deviation to first order; NaN without shear."""
    shear = np.hypot(one[FORCE_X], one[FORCE_Y])
    if shear == 0.0:
        return np.nan, np.nan
    relative = np.zeros(7)
    relative[FORCE_X:FORCE_Z] = one[FORCE_X:FORCE_Z] / shear**2
    relative[FORCE_Z] = -1.0 / one[FORCE_Z]
    relative[MARGIN] = 1.0 / (1.0 - one[MARGIN])
    mu = float(shear / (one[FORCE_Z] * (1.0 - one[MARGIN])))
    return mu, mu * float(np.sqrt(relative @ covariance @ relative))
