"""Readings of force sites and skins, and contacts on sites over time: identity, onset, release, duration, peak."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Final, Literal

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.forces.site_identification import SiteForce

ONSET_NEWTON: Final = 0.020
RELEASE_NEWTON: Final = 0.010
_CERTAIN_STDS: Final = 5.0  # the error of 2 gates, which do not show beats with the pilot, is up to 1.8 noises rms
_UNKNOWN: Final = Reason(ReasonCode.UNKNOWN_TOO_LONG, "its state was unknown for too long")
_GONE: Final = Reason(ReasonCode.NOT_DETECTED, "no touch is detected there any more")
_FELL: Final = Reason(ReasonCode.FORCE_FELL, f"below {RELEASE_NEWTON:g} N")

SensorStatus = Literal[
    "ok",
    "settling",
    "no_signal",
    "pilot_lost",
    "pressed_at_start",
    "ambiguous",
    "rejected",
    "overload",
    "possibly_more",
    "uncalibrated",
]


@dataclass(slots=True)  # not frozen, which takes three times as long to make: several for each reading
class Touch:
    """Touch in one reading: index of the nearest site, and the position with its covariance (2, 2)."""

    site: int
    position_m: tuple[float, float]
    position_covariance_m2: Floats
    force_newton: float
    noise_newton: float
    systematic_newton: float
    status: str
    reason: Reason | None = None
    at_least_newton: float | None = None


def touch_of(force: SiteForce, position_m: tuple[float, float], covariance_m2: Floats) -> Touch:
    """Return the touch of a site that is touched by itself: its place is the site's."""
    return Touch(
        force.site,
        position_m,
        covariance_m2,
        force.force_newton,
        force.noise_newton,
        force.systematic_newton,
        force.status,
        at_least_newton=force.at_least_newton,
    )


@dataclass(slots=True)  # not frozen, which takes three times as long to make: several for each reading
class Contact:
    """A touch from its onset on. An unknown force is NaN, with the cause in the touch's status and reason.

    `since_ticks` is the end of the window in which it set on, `duration_ticks` the time from there to the last reading
    that gave its force. `peak_noise_newton` is the noise of the peak; `peak_is_bound`: the contact was overloaded, and
    its greatest force is at least `peak_newton`.
    """

    id: int
    touch: Touch
    peak_newton: float
    since_ticks: int
    duration_ticks: int
    peak_noise_newton: float = math.nan
    peak_is_bound: bool = False


@dataclass(frozen=True, slots=True)
class ContactEvent:
    """Onset or release of a contact, at the board ticks of the reading that showed it."""

    event: Literal["onset", "release"]
    board_ticks: int
    contact: Contact
    reason: Reason | None  # of a release


class ContactTracker:
    """Tracker of contacts: touches, reading by reading, to contacts.

    A contact sets on at 20 mN that are five times their noise above 10 mN, or with an overload. It ends below 10 mN or
    when a reading that covers all touches has none there. A gap does not end it: its force is unknown, and only when
    that lasts longer than `unknown_ticks` is it released for that reason. A touch belongs to the nearest contact within
    `reach_m`: 0 where positions are those of sites.
    """

    def __init__(self, unknown_ticks: int, reach_m: float = 0.0) -> None:
        self._unknown_ticks = unknown_ticks
        self._reach_m = reach_m
        self._open: dict[int, Contact] = {}
        self._last_id = 0

    @property
    def contacts(self) -> tuple[Contact, ...]:
        return tuple(self._open.values())

    def update(
        self, board_ticks: int, touches: Sequence[Touch], *, complete: bool, status: str, reason: Reason | None
    ) -> tuple[ContactEvent, ...]:
        """Update with one reading.

        If `complete`, there are no touches but these; else `status` and `reason` give the cause for which the force of
        contacts without a touch is not known.
        """
        if not touches and not self._open:
            return ()
        events = [
            self._release(contact.id, board_ticks, _UNKNOWN)
            for contact in self.contacts
            if board_ticks - contact.since_ticks - contact.duration_ticks > self._unknown_ticks
        ]
        contact_of = self._associate(touches)
        for contact in list(self._open.values()):
            if contact.id in contact_of.values():
                continue
            if complete:
                events.append(self._release(contact.id, board_ticks, _GONE))
                continue
            self._open[contact.id] = replace(contact, touch=_unknown(contact.touch, status, reason))
        for index, touch in enumerate(touches):
            events += self._track(board_ticks, touch, contact_of.get(index))
        return tuple(events)

    def close(self, board_ticks: int, reason: Reason) -> tuple[ContactEvent, ...]:
        """Release every contact, as after a restart of the board."""
        return tuple(self._release(number, board_ticks, reason) for number in list(self._open))

    def _associate(self, touches: Sequence[Touch]) -> dict[int, int]:
        """Contact's id by index of touch, nearest pairs first."""
        if not touches or not self._open:
            return {}
        contacts = list(self._open.values())
        pairs = [
            (distance_m, index, contact.id)
            for index, touch in enumerate(touches)
            for contact in contacts
            if (distance_m := math.dist(touch.position_m, contact.touch.position_m)) <= self._reach_m
        ]
        contact_of: dict[int, int] = {}
        for _, index, number in sorted(pairs, key=itemgetter(0)):
            if index not in contact_of and number not in contact_of.values():
                contact_of[index] = number
        return contact_of

    def _track(self, board_ticks: int, touch: Touch, number: int | None) -> list[ContactEvent]:
        newton = touch.force_newton
        at_least = newton if touch.at_least_newton is None else touch.at_least_newton
        if number is None:
            onset_newton = max(ONSET_NEWTON, RELEASE_NEWTON + _CERTAIN_STDS * touch.noise_newton)
            if not (newton >= onset_newton or touch.status == "overload"):
                return []
            self._last_id += 1
            bound = touch.at_least_newton is not None
            contact = Contact(self._last_id, touch, at_least, board_ticks, 0, touch.noise_newton, bound)
            self._open[contact.id] = contact
            return [ContactEvent("onset", board_ticks, contact, None)]
        before = self._open[number]
        if math.isnan(at_least):
            self._open[number] = replace(before, touch=touch)
            return []
        peak_newton, noise_newton = before.peak_newton, before.peak_noise_newton
        if at_least > peak_newton:
            peak_newton, noise_newton = at_least, touch.noise_newton
        self._open[number] = Contact(
            number,
            touch,
            peak_newton,
            before.since_ticks,
            board_ticks - before.since_ticks,
            noise_newton,
            before.peak_is_bound or touch.at_least_newton is not None,
        )
        if newton < RELEASE_NEWTON:
            return [self._release(number, board_ticks, _FELL)]
        return []

    def _release(self, number: int, board_ticks: int, reason: Reason) -> ContactEvent:
        return ContactEvent("release", board_ticks, self._open.pop(number), reason)


def _unknown(touch: Touch, status: str, reason: Reason | None) -> Touch:
    """Return the touch without the numbers that the last reading did not give."""
    return replace(
        touch,
        force_newton=math.nan,
        noise_newton=math.nan,
        systematic_newton=math.nan,
        at_least_newton=None,
        status=status,
        reason=reason,
    )


@dataclass(slots=True)  # not frozen, which takes three times as long to make: one for each reading
class Compensation:
    """Compensation applied to the frequencies before their conversion to forces.

    `common_mode` is the relative frequency error taken out of each channel, `common_mode_std` what it may be off by.
    `baseline` is how it is known: "followed" from an untouched plate or from untouched tones, "held" during a touch,
    "unknown". `plate_kelvin` is the plate's temperature against its calibration's as the tones show it, NaN where none
    does. `response` is "on" if hysteresis and creep are taken out.
    """

    common_mode: tuple[float, ...]
    common_mode_std: float
    baseline: Literal["followed", "held", "unknown"]
    plate_kelvin: float
    plate_kelvin_std: float
    response: Literal["on", "off"]


CapturedTone = Literal["none", "pilot", "site", "unidentified"]


@dataclass(frozen=True, slots=True)
class CornerTone:
    """Tone that one corner captured, common mode taken out; NaN where it is not known.

    `site`, an index, is None unless a site's tone is `captured`. `noise_hz`, one standard deviation, is that of counter
    and oscillator. `residual` is the tone's relative shift less that of the identified force, over its standard error.
    """

    captured: CapturedTone
    site: int | None
    frequency_hz: float
    noise_hz: float
    residual: float
    reason_code: ReasonCode | None = None


@dataclass(slots=True)  # not frozen, which takes three times as long to make: one for each step
class ForceReading:
    """Forces and contacts from one window; NaN or absent where unknown, with `status` and `reason`.

    `board_ticks` is the end of the last gate in the window. `at_step` is false between two steps, where only events
    are new. `beats` are channels whose tone beats with the counter's reference: their noise counts for more. `tones`
    are those of the corners, where they are due.
    """

    sequence: int
    board_ticks: int
    window_s: float
    at_step: bool
    status: SensorStatus
    reason: Reason | None
    sites: tuple[SiteForce, ...]
    contacts: tuple[Contact, ...]
    events: tuple[ContactEvent, ...]
    compensation: Compensation
    beats: tuple[int, ...] = ()
    tones: tuple[CornerTone, ...] | None = None


@dataclass(frozen=True, slots=True)
class SkinReading:
    """Signals of one frame, the dimensionless triple [3 p_n / (2 E), eps_xz, eps_yz] and its noise, both (3, sites).

    `board_ticks` is the end of the gate. NaN where not known, with the cause in `status` and `reason`. `at_rest`: the
    skin has been untouched for so long that later readings do not depend on when the measurement began.
    """

    sequence: int
    board_ticks: int
    window_s: float
    status: SensorStatus
    reason: Reason | None
    signals: Floats
    noise_std: Floats
    common_mode: float
    at_rest: bool = False
