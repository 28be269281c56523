"""What touches a plate: the map of its sites and a table, or a decoded skin with forces and slip of its contacts."""

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from resonator_daemon.mqtt.payloads import Contact, SiteForce, Status
from resonator_daemon.mqtt.topics import CONTACTS, DECODED, DECODED_SUMMARY, FORCES, INFO
from resonator_daemon.tools.view.maps import (
    Line,
    SiteMark,
    as_pixels,
    pooling,
    round_scale,
    scale_bar,
    site_map,
    traction_map,
)
from resonator_daemon.tools.view.plate_view import PlateView, TrueContact, Truth
from resonator_daemon.tools.view.words import UNKNOWN, duration, millinewtons, newtons, pascals, quantity

_ROWS_MAX: Final = 16


class _Touch(NamedTuple):
    """A touch as measured and as it is; None where there is no such one."""

    site: int | None
    measured: SiteForce | None
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
        measured: dict[int, SiteForce] = {}
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


def _force_of_contact(contact: Contact) -> SiteForce:
    return SiteForce(
        site=contact.site,
        force_newton=contact.force_newton[2],
        noise_newton=contact.noise_newton[2],
        systematic_newton=math.nan if contact.systematic_newton is None else contact.systematic_newton,
        at_least_newton=contact.at_least_newton,
        status=contact.status,
    )


def _force(force: SiteForce | None) -> str:
    if force is None:
        return UNKNOWN
    if not math.isfinite(force.force_newton):
        return UNKNOWN if force.at_least_newton is None else f"at least {newtons(force.at_least_newton)}"
    noise, bound = millinewtons(force.noise_newton), millinewtons(force.systematic_newton)
    return f"{newtons(force.force_newton)} ± {noise} ± {bound} mN"


Floats = NDArray[np.floating]
Vector3 = tuple[float, float, float]

_GAP: Final = 2
_SCALE_COLUMNS: Final = 10
_NOISE_OF_SCALE: Final = 1 / 8  # how far up the scale the noise of an untouched skin goes
_SHEAR_MIN_NEWTON: Final = 5e-3  # below, noise decides the direction
_KNOWN: Final = (Status.OK, Status.CONSTRAINT_DROPPED)  # statuses of a surface that is known


class SurfacePanel:
    """Draws the last decoded frame of a plate, and its truth unless that is None."""

    def __init__(self, view: PlateView, truth: Truth | None, now_utc_ns: int, *, colours: bool) -> None:
        self._decoded = view.current(DECODED, now_utc_ns)
        self._summary = view.current(DECODED_SUMMARY, now_utc_ns)
        self._found = view.current(CONTACTS, now_utc_ns)
        self._info = view.last(INFO)
        self._truth = truth
        self._colours = colours
        self._maps: dict[str, Floats] = {}
        highest = [0.0]
        if self._decoded is not None:
            self._add_map("measured", self._decoded.traction_pascal[2])
            if (std := self._decoded.traction_std_pascal) is not None:
                highest.append(_max_known(std[2]) / _NOISE_OF_SCALE)
        if truth is not None and truth.traction_z_pascal is not None:
            self._add_map("true", truth.traction_z_pascal)
        self._full_pascal = round_scale(max(highest + [_max_known(traction) for traction in self._maps.values()]))

    def maps(self, rows: int, columns_max: int) -> list[list[Line]]:
        """Return the measured map and the true one, with a last line that names each."""
        columns_each = (columns_max - _GAP * (len(self._maps) - 1)) // max(len(self._maps), 1)
        blocks = []
        for name, traction in self._maps.items():
            ny, nx = traction.shape
            pool = pooling((ny, nx), rows - 1, columns_each)
            lines = traction_map(traction, self._full_pascal, pool, colours=self._colours)
            blocks.append([*lines, [Segment(name.center(Segment.get_line_length(lines[0])))]])
        return blocks

    def text(self) -> list[RenderableType]:
        parts: list[RenderableType] = [self._table(), Text(self._fit())]
        if self._maps:
            bar = ((cell.text, cell.style or "") for cell in scale_bar(_SCALE_COLUMNS, colours=self._colours))
            parts.append(Text.assemble("f_z 0 ", *bar, f" {pascals(self._full_pascal)}"))
        return parts

    def words(self) -> str:
        """Return the contacts in one line."""
        return f"{self._contacts()}; {self._fit()}"

    def _table(self) -> RenderableType:
        """One column a contact: forces, direction of the shear, margin to slip; the true sum next to them."""
        contacts = self._found.contacts if self._found else ()
        forces = [contact.force_newton for contact in contacts]
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        table.add_column("contact" if contacts else self._contacts())
        for contact in contacts:
            table.add_column(_name(contact), no_wrap=True)
        if self._truth is not None:
            forces.append(_sum_newton(self._truth.contacts))
            table.add_column("true", no_wrap=True)
        table.add_row("normal", *(newtons(z) for _, _, z in forces))
        table.add_row("shear", *(newtons(math.hypot(x, y)) for x, y, _ in forces))
        table.add_row("towards", *(_direction(x, y) for x, y, _ in forces))
        table.add_row("margin", *map(_margin, contacts))
        return table

    def _contacts(self) -> str:
        if self._found is None or self._found.status not in _KNOWN:
            return "contacts unknown"
        return ", ".join(map(_in_words, self._found.contacts)) or "no contact"

    def _fit(self) -> str:
        if self._decoded is None or self._summary is None:
            return "surface unknown: nothing decoded arrives"
        border = "reaches the border, expect errors there" if self._summary.border_contact else "clear of the border"
        chi2 = quantity(self._summary.chi2, ".2f", "")
        because = f" ({self._summary.reason})" if self._summary.reason else ""
        return f"status {self._summary.status}{because}, {self._summary.decoder} chi2 {chi2}, {border}"

    def _add_map(self, name: str, traction_pascal: Floats) -> None:
        """Add a map (ny, nx), or one of scattered sites (n,) once it is known where they are."""
        if traction_pascal.ndim == 2:
            self._maps[name] = traction_pascal
        elif self._info is not None and len(self._info.sites) == len(traction_pascal):
            positions_m = tuple(site.position_m for site in self._info.sites)
            self._maps[name] = as_pixels(traction_pascal, self._info.outline_m, positions_m)


def _sum_newton(contacts: Sequence[TrueContact]) -> Vector3:
    x, y, z = (math.fsum(contact.force_newton[axis] for contact in contacts) for axis in range(3))
    return x, y, z


def _max_known(values: Floats) -> float:
    return float(np.max(values, initial=0.0, where=np.isfinite(values)))


def _direction(x_newton: float, y_newton: float) -> str:
    if not math.hypot(x_newton, y_newton) >= _SHEAR_MIN_NEWTON:
        return UNKNOWN
    return f"{round(math.degrees(math.atan2(y_newton, x_newton)))}°"


def _name(contact: Contact) -> str:
    return UNKNOWN if contact.id is None else str(contact.id)


def _in_words(contact: Contact) -> str:
    x, y, z = contact.force_newton
    shear = newtons(math.hypot(x, y))
    return f"contact {_name(contact)} {newtons(z)} normal, {shear} shear, slip margin {_margin(contact)}"


def _margin(contact: Contact) -> str:
    margin, std = contact.slip_margin, contact.slip_margin_std
    if margin is None or std is None or not math.isfinite(margin):
        return UNKNOWN
    return f"{margin:.2f} ± {quantity(std, '.2f', '')}"
