"""Slip over time: margins frame by frame, friction estimated on the way, and slip announced as it sets in."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.contact_start import ContactStart, Friction
from resonator_daemon.estimate.surface.fitting.partial_slip import PartialSlip
from resonator_daemon.estimate.surface.fitting.slip_fitter import SlipFitter

INCIPIENT_MARGIN = 0.3  # below it slip is announced ...
REARM_MARGIN = 0.4  # ... and above this, it may be announced again
_IN_A_ROW = 2  # frames that must agree on an event: one may be noise
_GROSS_MARGIN = 0.1  # where a margin that may be 0 is taken as 0
_SIGNIFICANCE = 2.0  # standard deviations
_KNOWN = 0.1  # relative standard deviation at which a coefficient begins to count as known
_KNOWN_FLOOR = 0.03  # relative standard deviation to which frames can bring it; friction changes, and models are wrong


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
    """

    def __init__(self, model: DiscModel, friction: Friction | None = None) -> None:
        self._fitter = SlipFitter(model)
        self._friction = friction
        self._followed: dict[int, _Followed] = {}

    def update(
        self, signals: ArrayLike, noise_std: ArrayLike, contacts: Mapping[int, ContactStart]
    ) -> tuple[dict[int, PartialSlip], tuple[SlipEvent, ...]]:
        """Fit a frame; return fits and events by the ids of `contacts`.

        A contact is identified by its id; the start it comes with serves while the frame before gives no better. One
        that is absent is discarded. An event comes once, and again only after the margin has exceeded 0.4.
        Arguments otherwise and errors as of `fit_partial_slip`.
        """
        for gone in self._followed.keys() - contacts.keys():
            del self._followed[gone]
        for contact, start in contacts.items():
            if contact not in self._followed:
                self._followed[contact] = _Followed(replace(start, friction=start.friction or self._friction))
            elif not np.isfinite(self._followed[contact].start.radius_m):
                self._followed[contact].start = replace(start, friction=self._followed[contact].start.friction)
        if not contacts:
            return {}, ()
        starts = {contact: self._followed[contact].start for contact in contacts}
        fits = self._fitter.fit(signals, noise_std, starts)
        events = []
        for contact, slip in fits.items():
            followed = self._followed[contact]
            events += [SlipEvent(event, contact, slip) for event in _announce(followed, slip)]
            followed.start = ContactStart(
                (float(slip.centre_m[0]), float(slip.centre_m[1])),
                slip.radius_m,
                slip.slip_margin,
                _updated_friction(followed.start.friction, slip),
            )
        return fits, tuple(events)


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
