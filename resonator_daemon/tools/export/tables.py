"""Messages as rows of tables, a table for each topic."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any, Final

from resonator_daemon.base.plate import Plate
from resonator_daemon.mqtt.payloads import (
    Compensation,
    Contact,
    ContactEvent,
    Contacts,
    Decoded,
    DecodedSummary,
    Forces,
    Message,
    Patch,
    Signals,
    SiteForce,
    State,
)
from resonator_daemon.mqtt.topics import (
    CONTACT_EVENT,
    CONTACTS,
    DECODED,
    DECODED_SUMMARY,
    FORCES,
    SIGNALS,
    STATE_LINK,
    STATE_SENSOR,
    Topic,
)
from resonator_daemon.mqtt.units import NO_UNIT
from resonator_daemon.tools.export.columns import Column, Source, Value, array_sources, sources

_NOTHING_PRESSES: Final = "; missing where nothing presses on the site"

Row = Sequence[Value]
_MakeTable = Callable[[Plate, Message | None], "Table"]


class Table:
    """The columns of a topic, and the rows that each of its messages gives.

    Parameters
    ----------
    per_message
        Columns whose values stand in each row of a message.
    per_item
        Those of each part that the message has many of.
    items
        Takes these parts out of a message. One that has none gives one row, where the parts' columns are missing; so
        that the rows of a topic show all its messages. None where each message is one row.
    """

    def __init__(
        self,
        per_message: Sequence[Source],
        per_item: Sequence[Source] = (),
        items: Callable[[Any], Sequence[Message]] | None = None,
    ) -> None:
        self._get = tuple(source.get for source in per_message)
        self._get_of_item = tuple(source.get for source in per_item)
        self._items = items
        nullable = (replace(source.column, nullable=True) for source in per_item)
        self.columns: tuple[Column, ...] = (*(source.column for source in per_message), *nullable)

    def rows(self, message: Message) -> Iterator[Row]:
        """Give the rows of a message, values in the order of the columns."""
        values = [get(message) for get in self._get]
        if self._items is None:
            yield values
            return
        for item in self._items(message):
            yield [*values, *(get(item) for get in self._get_of_item)]
        if not self._items(message):
            yield [*values, *(None for _ in self._get_of_item)]


def make_table(topic: Topic[Any], plate: Plate, first: Message | None) -> Table:
    """Return the table of a topic; arrays have the shapes of those in its first message."""
    return _MAKE[topic.path](plate, first)


def _forces(plate: Plate, _first: Message | None) -> Table:
    values = [*sources(Forces, skip=("sites", "beats")), *map(_beats, range(len(plate.transducers_m)))]
    return Table([*values, *(source for site in plate.site_ids for source in _of_site(int(site)))])


def _of_site(site: int) -> Iterator[Source]:
    for source in sources(SiteForce, prefix=f"site_{site}_", skip=("site",)):
        column, get = source.column, source.get

        def of_message(message: Forces, get: Callable[[SiteForce], Value] = get) -> Value:
            return next((get(force) for force in message.sites if force.site == site), None)

        description = column.description + _NOTHING_PRESSES
        yield Source(replace(column, nullable=True, description=description), of_message)


def _beats(channel: int) -> Source:
    description = "its tone beats with the board's reference clock; `noise_newton` counts for that"
    return Source(
        Column(f"channel_{channel}_beats", "bool", False, (), description),
        lambda message: channel in (message.beats or ()),
    )


def _common_mode(channel: int) -> Source:
    def get(message: State) -> Value:
        common_mode = message.compensation.common_mode if message.compensation is not None else ()
        return common_mode[channel] if channel < len(common_mode) else None

    description = Compensation.model_fields["common_mode"].description or ""
    name = f"compensation_channel_{channel}_common_mode"
    return Source(Column(name, "float64", True, (), description, NO_UNIT), get)


def _sensor_state(plate: Plate, _first: Message | None) -> Table:
    of_part = sources(Compensation, prefix="compensation_", skip=("common_mode",), within=("compensation",))
    return Table(
        [
            *sources(State, skip=("compensation",)),
            *map(_common_mode, range(len(plate.transducers_m))),
            *(replace(source, column=replace(source.column, nullable=True)) for source in of_part),
        ]
    )


def _plain(model: type[Message], items: str = "", item: type[Message] | None = None) -> _MakeTable:
    """Return what makes the table of a kind of message, with a row for each of its items if it has many."""
    per_message = list(sources(model, skip=(items,)))
    if item is None:
        return lambda _plate, _first: Table(per_message)
    per_item = list(sources(item, prefix=f"{item.__name__.lower()}_"))
    return lambda _plate, _first: Table(per_message, per_item, attrgetter(items))


def _with_arrays(model: type[Message], *keys: str) -> _MakeTable:
    """Return what makes the table of a kind of message with arrays, whose shapes are those of the first message."""
    return lambda _plate, first: Table([*sources(model, skip=keys), *(array_sources(first, keys) if first else ())])


_MAKE: Final[Mapping[str, _MakeTable]] = {
    FORCES.path: _forces,
    CONTACTS.path: _plain(Contacts, "contacts", Contact),
    CONTACT_EVENT.path: _plain(ContactEvent),
    SIGNALS.path: _with_arrays(Signals, "signals", "noise_std"),
    DECODED.path: _with_arrays(Decoded, "traction_pascal", "traction_std_pascal", "displacement_m"),
    DECODED_SUMMARY.path: _plain(DecodedSummary, "patches", Patch),
    STATE_LINK.path: _plain(State, "compensation"),
    STATE_SENSOR.path: _sensor_state,
}
WITH_TABLE: Final = tuple(_MAKE)
"""Paths of the topics that have a table."""
WITH_ARRAYS: Final = (SIGNALS.path, DECODED.path)
"""Those whose tables have arrays."""
