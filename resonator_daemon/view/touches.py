"""A plate of force sites: a map of its sites, and a table of those that are touched."""

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

from rich.console import RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from resonator_daemon.publishing.payloads import Contact, SiteForce, Status
from resonator_daemon.publishing.topics import CONTACTS, FORCES, INFO
from resonator_daemon.view.maps import Line, SiteMark, site_map
from resonator_daemon.view.plate_view import PlateView, TrueContact, Truth
from resonator_daemon.view.words import UNKNOWN, duration, millinewtons, newtons

_ROWS_MAX: Final = 16


class _Force(NamedTuple):
    """A measured force, from `forces` or `contacts`."""

    force_newton: float
    noise_newton: float
    systematic_newton: float
    at_least_newton: float | None
    status: Status


class _Touch(NamedTuple):
    """A touch as measured and as it is; None where there is no such one."""

    site: int | None
    measured: _Force | SiteForce | None
    true: TrueContact | None
    lasted_s: float


class TouchesPanel:
    """Draws the last forces and contacts of a plate, and its truth unless that is None."""

    def __init__(self, view: PlateView, truth: Truth | None, now_utc_ns: int) -> None:
        self._view = view
        self._info = view.last(INFO)
        self._forces = view.current(FORCES, now_utc_ns)
        self._contacts = view.current(CONTACTS, now_utc_ns)
        self._truth = truth
        self._touches = sorted(self._all_touches(), key=lambda touch: math.inf if touch.site is None else touch.site)

    def maps(self, rows: int, columns_max: int) -> list[list[Line]]:
        """Return the map, with a last line that explains its marks; nothing before the plate is known."""
        if self._info is None:
            return []
        touches = {touch.site: touch for touch in self._touches}
        marks = [
            SiteMark(site.position_m, str(site.site), *_forces_of(touches.get(site.site))) for site in self._info.sites
        ]
        marks += [
            SiteMark(touch.true.position_m, "", None, touch.true.force_newton[2])
            for touch in self._touches
            if touch.site is None and touch.true is not None
        ]
        force_max = self._info.force_max_newton
        lines = site_map(self._info.outline_m, marks, force_max, min(rows - 1, _ROWS_MAX), columns_max)
        width = Segment.get_line_length(lines[0])
        marks_mean = "measured ▄7▄ true" if self._truth else "force ▄7"
        legends = (f"{marks_mean}, █ {force_max:g} N", f"█ {force_max:g} N", "")
        legend = next(legend for legend in legends if len(legend) <= width)
        return [[*lines, [Segment(legend.center(width))]]]

    def text(self) -> list[RenderableType]:
        if not self._touches:
            return [Text(self.words())]
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        table.add_column("site", justify="right")
        table.add_column("force ± noise ± bound", no_wrap=True)
        if self._truth is not None:
            table.add_column("true", no_wrap=True)
        table.add_column("status")
        table.add_column("since", no_wrap=True)
        for touch in self._touches:
            true = () if self._truth is None else (newtons(touch.true.force_newton[2]) if touch.true else UNKNOWN,)
            status = touch.measured.status if touch.measured else "not measured"
            since = duration(touch.lasted_s)
            table.add_row(
                "between" if touch.site is None else str(touch.site), _force(touch.measured), *true, status, since
            )
        return [table, Text(self._status())]

    def words(self) -> str:
        """Return the touches in one line."""
        found = [f"site {touch.site} {_force(touch.measured)}" for touch in self._touches if touch.measured]
        if found:
            return f"{', '.join(found)}; {self._status()}"
        return "no touch" if self._forces is not None and self._forces.status is Status.OK else self._status()

    def _status(self) -> str:
        if self._forces is None:
            return "forces unknown: none arrive"
        because = f" ({self._forces.reason})" if self._forces.reason else ""
        return f"status {self._forces.status}{because}"

    def _all_touches(self) -> Iterator[_Touch]:
        measured: dict[int, _Force | SiteForce] = {}
        lasted_s = {}
        if self._contacts is not None:
            for contact in self._contacts.contacts:
                measured[contact.site] = _force_of_contact(contact)
                now_ns = self._contacts.t_ns
                lasted_s[contact.site] = (now_ns - self._view.contact_since_t_ns(contact.id, now_ns)) / 1e9
        if self._forces is not None:
            measured |= {force.site: force for force in self._forces.sites}
        on_sites: dict[int, TrueContact] = {}
        for truth in self._truth.contacts if self._truth else ():
            if truth.site is None:
                yield _Touch(None, None, truth, math.nan)
            else:
                on_sites[truth.site] = truth
        for site in measured.keys() | on_sites.keys():
            yield _Touch(site, measured.get(site), on_sites.get(site), lasted_s.get(site, math.nan))


def _forces_of(touch: _Touch | None) -> tuple[float | None, float | None]:
    if touch is None:
        return None, None
    measured = touch.measured.force_newton if touch.measured else None
    return measured, touch.true.force_newton[2] if touch.true else None


def _force_of_contact(contact: Contact) -> _Force:
    normal_newton, noise_newton = contact.force_newton[2], contact.noise_newton[2]
    systematic_newton = math.nan if contact.systematic_newton is None else contact.systematic_newton
    return _Force(normal_newton, noise_newton, systematic_newton, contact.at_least_newton, contact.status)


def _force(force: _Force | SiteForce | None) -> str:
    if force is None:
        return UNKNOWN
    if not math.isfinite(force.force_newton):
        return UNKNOWN if force.at_least_newton is None else f"at least {newtons(force.at_least_newton)}"
    noise, bound = millinewtons(force.noise_newton), millinewtons(force.systematic_newton)
    return f"{newtons(force.force_newton)} ± {noise} ± {bound} mN"
