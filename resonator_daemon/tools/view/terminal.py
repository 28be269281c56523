"""The live view in a terminal: states, contacts and losses of some plates, one below the other."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.mqtt.payloads import Condition, Contact, State, Status
from resonator_daemon.mqtt.topics import (
    CONTACTS,
    DECODED,
    DECODED_SUMMARY,
    FORCES,
    HEALTH,
    INFO,
    STATE_DAEMON,
    STATE_LINK,
    STATE_SENSOR,
)
from resonator_daemon.tools.view.plate_view import HISTORY_NS, PlateView
from resonator_daemon.tools.view.words import UNKNOWN, duration, losses_in_words, millinewtons, newtons, quantity

Truth = Sequence[Mapping[str, Any]]
"""Contacts of an emulated plate as its truth file has them."""

_BLOCKS: Final = " ▁▂▃▄▅▆▇█"
_GRAPH_ROWS: Final = 8
_OTHER_ROWS: Final = 7  # of a plate: rule, states, table of contacts, figures
_LABEL_WIDTH: Final = 10
_SILENT_S: Final = 3.0  # a running daemon publishes its health once a second
_COLUMNS: Final = ("contact", "site", "x, y in mm", "normal ± noise ± systematic", "shear", "slip margin", "since")


def render(views: Sequence[PlateView], truths: Mapping[str, Truth], now_utc_ns: int, *, title: str) -> RenderableType:
    """Return a page with every plate; true contacts stand below the measured ones of the plates that have them."""
    plates = [part for view in views for part in _plate(view, truths.get(view.name, ()), now_utc_ns, len(views))]
    return Group(Text(title, style="bold"), *plates)


def summary_line(view: PlateView, now_utc_ns: int) -> str:
    """Return a plate in one line of text, for where there is no terminal."""
    touches = (
        f"contact {contact.id!s} at site {contact.site} {_normal(contact)}" for contact in _contacts(view, now_utc_ns)
    )
    return "; ".join([f"{view.name}: {_states(view, now_utc_ns).plain}", *touches, _figures(view, now_utc_ns)])


def _plate(view: PlateView, truth: Truth, now_utc_ns: int, plates: int) -> Iterator[RenderableType]:
    info = view.last(INFO)
    words = [view.name, *((info.plate, info.link) if info else ("plate unknown",))]
    heading = Text(" · ".join(dict.fromkeys(words)), style="bold")  # a plate may be named after its kind
    yield _Fitting(heading.cell_len + 2, Rule(heading, align="left", style="dim"), heading)
    yield _states(view, now_utc_ns)
    contacts = _contacts(view, now_utc_ns)
    if contacts or truth:
        yield _table(view, contacts, truth, now_utc_ns)
    yield Text(_figures(view, now_utc_ns))
    if view.current(CONTACTS, now_utc_ns) and any(newton > 0.0 for _, newton in view.pressed):
        yield _Graph(view.pressed, now_utc_ns, plates)


class _Fitting(NamedTuple):
    """A renderable for terminals with at least so many columns, and another for narrower ones."""

    columns: int
    wide: RenderableType
    narrow: RenderableType

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        yield self.wide if options.max_width >= self.columns else self.narrow


class _Graph(NamedTuple):
    """The largest normal force of the last seconds, as high as the terminal has room for with so many plates."""

    pressed: Sequence[tuple[int, float]]
    now_utc_ns: int
    plates: int

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Text]:
        rows = min((console.height - 1) // self.plates - _OTHER_ROWS, _GRAPH_ROWS)
        heights = [0.0] * max(options.max_width - _LABEL_WIDTH, 1)
        for arrived_utc_ns, newton in self.pressed:
            column = len(heights) - 1 - len(heights) * (self.now_utc_ns - arrived_utc_ns) // HISTORY_NS
            if 0 <= column < len(heights):
                heights[column] = max(heights[column], newton)
        highest = max(heights)
        for row in reversed(range(rows) if highest > 0.0 and rows > 1 else ()):
            label = newtons(highest) if row == rows - 1 else f"-{HISTORY_NS / 1e9:.0f} s" if row == 0 else ""
            eighths = (min(max(round(8 * (rows * height / highest - row)), 0), 8) for height in heights)
            yield Text(f"{label:>{_LABEL_WIDTH - 1}} " + "".join(_BLOCKS[eighth] for eighth in eighths), no_wrap=True)


def _contacts(view: PlateView, now_utc_ns: int) -> Sequence[Contact]:
    message = view.current(CONTACTS, now_utc_ns)
    return message.contacts if message is not None else ()


def _states(view: PlateView, now_utc_ns: int) -> Text:
    daemon, link, sensor = (view.last(topic) for topic in (STATE_DAEMON, STATE_LINK, STATE_SENSOR))
    offline = daemon is not None and daemon.state is Condition.OFFLINE
    silent = view.age_s(now_utc_ns) > _SILENT_S
    away = silent or offline
    parts = (("daemon", daemon, silent and not offline), ("link", link, away), ("sensor", sensor, away))
    return Text("   ").join(_state(name, state, now_utc_ns, outdated=outdated) for name, state, outdated in parts)


def _state(name: str, state: State | None, now_utc_ns: int, *, outdated: bool) -> Text:
    text = Text(f"{name} ")
    if state is None:
        return text.append("unknown", "reverse")
    if outdated:
        return text.append("unknown", "reverse").append(f" (was {state.state})")
    if state.state is Condition.ONLINE and state.reason_code != ReasonCode.COMPUTER_BUSY:
        return text.append("online", "bold")
    text.append(state.state, "reverse")
    if state.since_t_ns is not None:
        text.append(f" for {duration((now_utc_ns - state.since_t_ns) / 1e9)}")
    return text.append(f": {state.reason}")


def _table(view: PlateView, contacts: Sequence[Contact], truth: Truth, now_utc_ns: int) -> RenderableType:
    """Return a table with a row for each contact; a paragraph for each where the table would cut its words."""
    rows = []
    for contact in contacts:
        lasted_s = (now_utc_ns - view.contact_since_t_ns(contact.id, now_utc_ns)) / 1e9
        place, shear = _place(contact.position_m), _shear(contact.force_newton)
        row = (str(contact.id), str(contact.site), place, _normal(contact), shear, _margin(contact), duration(lasted_s))
        rows.append(row)
    for true in truth:
        site = "between" if true["site"] is None else str(true["site"])
        force = true["force_newton"]
        rows.append(("true", site, _place(true["position_m"]), newtons(force[2]), _shear(force), "", ""))
    table = Table(*_COLUMNS, box=None, padding=(0, 2, 0, 0), pad_edge=False)
    for row in rows:
        table.add_row(*row)
    word = max(map(len, " ".join(map(" ".join, (_COLUMNS, *rows))).split()))  # rich narrows wide columns to one width
    widths = (min(max(map(len, column)), word) for column in zip(_COLUMNS, *rows, strict=True))
    named = (zip(_COLUMNS, row, strict=True) for row in rows)
    text = "\n".join("; ".join(f"{name} {cell}" for name, cell in row if cell not in ("", UNKNOWN)) for row in named)
    return _Fitting(sum(widths) + 2 * (len(_COLUMNS) - 1), table, Text(text))


def _place(position_m: Sequence[float]) -> str:
    return ", ".join(quantity(1e3 * coordinate, ".2f", "") for coordinate in position_m)


def _normal(contact: Contact) -> str:
    force_newton, systematic_newton = contact.force_newton[2], contact.systematic_newton
    if not math.isfinite(force_newton):
        known = UNKNOWN if contact.at_least_newton is None else f"at least {newtons(contact.at_least_newton)}"
        return f"{known} ({contact.status})"
    bound = UNKNOWN if systematic_newton is None else millinewtons(systematic_newton[2])
    status = "" if contact.status is Status.OK else f" ({contact.status})"
    return f"{newtons(force_newton)} ± {millinewtons(contact.noise_newton[2])} ± {bound} mN{status}"


def _shear(force_newton: Sequence[float]) -> str:
    x, y, _ = force_newton
    size_newton = math.hypot(x, y)
    if not math.isfinite(size_newton):
        return UNKNOWN
    return f"{newtons(size_newton)} at {round(math.degrees(math.atan2(y, x)))}°"


def _margin(contact: Contact) -> str:
    margin = contact.slip_margin
    if margin is None or not math.isfinite(margin):
        return UNKNOWN
    return f"{margin:.2f} ± {quantity(contact.slip_margin_std, '.2f', '')}"


def _figures(view: PlateView, now_utc_ns: int) -> str:
    """Return what is measured, its status, losses and rates."""
    parts = []
    summary, forces = view.current(DECODED_SUMMARY, now_utc_ns), view.current(FORCES, now_utc_ns)
    measured = summary or forces
    if measured is None:
        parts.append("nothing measured arrives")
    else:
        found = view.current(CONTACTS, now_utc_ns)
        if measured.status is Status.OK and found is not None and not found.contacts:
            parts.append("no contact")
        parts.append(f"status {measured.status}" + (f" ({measured.reason})" if measured.reason else ""))
    if summary is not None:
        border = ", the contact reaches the border: expect errors there" if summary.border_contact else ""
        parts.append(f"{summary.decoder}{border}")
    health = view.current(HEALTH, now_utc_ns)
    if view.lost is None:
        parts.append("losses unknown")
    else:
        of_health = {"parts": health.parts_lost, "not_decoded": health.frames_not_decoded} if health else {}
        rate = f" ({view.loss_rate_hz:.1f}/s)" if view.loss_rate_hz else ""
        parts.append(losses_in_words(view.lost.model_dump() | of_health) + rate)
    parts.append(f"frames {quantity(health.frame_rate_hz if health else None, '.1f', '/s')}")
    name, topic = ("forces", FORCES) if summary is None else ("decoded", DECODED)
    parts.append(f"{name} {quantity(view.rate_hz(topic, now_utc_ns), '.0f', '/s')}")
    if health is None:
        parts.append("health unknown")
    else:
        parts.append(f"processor {quantity(health.cpu_percent, '.0f', ' %')}")
        parts.append(f"memory {quantity(health.rss_mb, '.0f', ' MB')}")
        parts.append(f"clock drift {quantity(health.clock_drift_ppm, '+.2f', ' ppm')}")
    return "; ".join(parts)
