"""Contacts over time: identity, onset and release with hysteresis, peak, and what is unknown meanwhile."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from resonator_daemon.measurement.force import FloatArray
from resonator_daemon.measurement.matching import SiteForce

ONSET_NEWTON: Final = 0.020
RELEASE_NEWTON: Final = 0.010


@dataclass(frozen=True, slots=True)
class Contact:
    """A touch of one site, an index into the plate's sites; its position is the site's.

    `position_std_m` is the spread of touches nearest to the site. `since_ticks` is the end of the window in which the
    contact set on. While the force is not known it is NaN, and `status` and `reason` say why.
    """

    id: int
    site: int
    position_m: tuple[float, float]
    position_std_m: tuple[float, float]
    force_newton: float
    noise_newton: float
    systematic_newton: float
    at_least_newton: float | None
    peak_newton: float
    since_ticks: int
    status: str
    reason: str


@dataclass(frozen=True, slots=True)
class ContactEvent:
    """Onset or release of a contact, at the board's tick count of the reading that told it."""

    event: Literal["onset", "release"]
    board_ticks: int
    contact: Contact
    reason: str


class ContactTracker:
    """Turns forces on sites into contacts.

    A contact sets on at 20 mN, or with an overload, and ends below 10 mN or when the plate is heard untouched. A gap
    does not end it: its force is unknown, and only when that lasts longer than `unknown_ticks` is it released for that
    reason.
    """

    def __init__(self, site_positions_m: FloatArray, position_std_m: FloatArray, unknown_ticks: int) -> None:
        """Take positions and their standard deviations as (m, 2)."""
        if (
            site_positions_m.ndim != 2
            or site_positions_m.shape[1] != 2
            or position_std_m.shape != site_positions_m.shape
        ):
            raise ValueError(f"positions {site_positions_m.shape} and their std {position_std_m.shape} must be (m, 2)")
        self._positions_m = [(float(x), float(y)) for x, y in site_positions_m]
        self._position_std_m = [(float(x), float(y)) for x, y in position_std_m]
        self._unknown_ticks = unknown_ticks
        self._open: dict[int, Contact] = {}  # by site
        self._known_ticks: dict[int, int] = {}  # by site: when its force was last known
        self._last_id = 0

    @property
    def contacts(self) -> tuple[Contact, ...]:
        return tuple(self._open.values())

    def update(
        self, board_ticks: int, forces: Sequence[SiteForce], *, untouched: bool, status: str, reason: str
    ) -> tuple[ContactEvent, ...]:
        """Take one reading; `status` and `reason` say why the force on sites that are not in `forces` is not known."""
        events = []
        for site in [] if untouched else [site for site in self._open if all(force.site != site for force in forces)]:
            self._open[site] = replace(
                self._open[site],
                force_newton=math.nan,
                noise_newton=math.nan,
                systematic_newton=math.nan,
                at_least_newton=None,
                status=status,
                reason=reason,
            )
            if board_ticks - self._known_ticks[site] > self._unknown_ticks:
                events.append(self._release(site, board_ticks, "its state was unknown for too long"))
        if untouched:
            events += [self._release(site, board_ticks, "the pilot is heard") for site in list(self._open)]
        for force in forces:
            events += self._take(board_ticks, force)
        return tuple(events)

    def close(self, board_ticks: int, reason: str) -> tuple[ContactEvent, ...]:
        """Release every contact, as when the board starts anew and its past no longer tells anything."""
        return tuple(self._release(site, board_ticks, reason) for site in list(self._open))

    def _take(self, board_ticks: int, force: SiteForce) -> list[ContactEvent]:
        site, newton = force.site, force.force_newton
        before = self._open.get(site)
        if before is None and not (force.status == "overload" or newton >= ONSET_NEWTON):
            return []
        self._last_id += before is None
        at_least = newton if force.at_least_newton is None else force.at_least_newton
        contact = Contact(
            id=before.id if before else self._last_id,
            site=site,
            position_m=self._positions_m[site],
            position_std_m=self._position_std_m[site],
            force_newton=newton,
            noise_newton=force.noise_newton,
            systematic_newton=force.systematic_newton,
            at_least_newton=force.at_least_newton,
            peak_newton=max(before.peak_newton, at_least) if before else at_least,
            since_ticks=before.since_ticks if before else board_ticks,
            status=force.status,
            reason="",
        )
        self._open[site] = contact
        self._known_ticks[site] = board_ticks
        if before is None:
            return [ContactEvent("onset", board_ticks, contact, "")]
        if newton < RELEASE_NEWTON:
            return [self._release(site, board_ticks, f"below {RELEASE_NEWTON:g} N")]
        return []

    def _release(self, site: int, board_ticks: int, reason: str) -> ContactEvent:
        del self._known_ticks[site]
        return ContactEvent("release", board_ticks, self._open.pop(site), reason)
