"""Messages as rows of tables, a table for each topic; columns are named, with units, and of one type each."""

import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from operator import attrgetter
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainSerializer
from pydantic.fields import FieldInfo

from resonator_daemon.base.plate import Plate
from resonator_daemon.mqtt import payloads, topics
from resonator_daemon.mqtt.payload_types import AXES, NO_UNIT, unit_of, with_axis

DataType = Literal["int64", "uint64", "float64", "bool", "text", "float32 array"]
Value = int | float | bool | str | NDArray[np.float32] | None
Get = Callable[[Any], Value]

_COMPONENTS: Final = {"position_covariance_m2": ("xx", "xy", "yy")}  # of vectors that are not along the axes


@dataclass(frozen=True)
class Column:
    """One column.

    Parameters
    ----------
    name
        With its unit at the end, as keys of messages have it.
    data_type
        Of each value.
    nullable
        Whether a value may be missing; a number that is not known is NaN and not missing.
    shape
        Of each array.
    description
        What it means.
    unit
        Of numbers, in the notation of UCUM; empty where they count or name.
    """

    name: str
    data_type: DataType
    nullable: bool = False
    shape: tuple[int, ...] = ()
    description: str = ""
    unit: str = ""

    @property
    def counts(self) -> bool:
        """Whether values are whole numbers or truth values, which cannot be NaN where they are missing."""
        return self.data_type in ("int64", "uint64", "bool")


@dataclass(frozen=True)
class Source:
    """A column and where its values come from."""

    column: Column
    get: Get


def sources(
    model: type[payloads.Message], *, prefix: str = "", skip: tuple[str, ...] = (), within: tuple[str, ...] = ()
) -> Iterator[Source]:
    """Give the columns of a kind of message: parts within it with their key before theirs, vectors by component.

    Parameters
    ----------
    prefix
        Goes before each name.
    skip
        Keys to be left out.
    within
        Keys that lead to the part that is of this kind.

    Raises
    ------
    ValueError
        A key is no number, word or array, nor a vector or part made of these.
    """
    for key, field in model.model_fields.items():
        if key not in skip:
            yield from _of_field(prefix + key, (*within, key), _annotation(field), field.description or "")


def array_sources(message: payloads.Message, keys: tuple[str, ...]) -> Iterator[Source]:
    """Give columns for the arrays that a message has, of the shapes they have."""
    for key in keys:
        array = getattr(message, key)
        if array is not None:
            description = type(message).model_fields[key].description or ""
            column = Column(key, "float32 array", True, array.shape, description, unit_of(key) or "")
            yield Source(column, _follow(key))


def _of_field(name: str, keys: tuple[str, ...], annotation: Any, description: str) -> Iterator[Source]:
    bare, optional = _without_none(annotation)
    unit = unit_of(keys[-1]) or ""
    if isinstance(bare, type) and issubclass(bare, payloads.Message):
        for inner in sources(bare, prefix=f"{name}_", within=keys):
            yield replace(inner, column=replace(inner.column, nullable=inner.column.nullable or optional))
    elif get_origin(bare) is tuple and Ellipsis not in get_args(bare):
        for index, axis in enumerate(_COMPONENTS.get(keys[-1], AXES[: len(get_args(bare))])):
            column = Column(with_axis(name, axis), "float64", optional, (), f"{axis}: {description}", unit)
            yield Source(column, _follow(*keys, index))
    else:
        yield Source(Column(name, _data_type(name, bare), optional, (), description, unit), _follow(*keys))


def _annotation(field: FieldInfo) -> Any:
    """Return what is annotated, with what pydantic has taken off it."""
    return Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation


def _without_none(annotation: Any) -> tuple[Any, bool]:
    if get_origin(annotation) is Annotated:
        inner, *metadata = get_args(annotation)
        present, optional = _without_none(inner)
        return (Annotated[present, *metadata], True) if optional else (annotation, False)
    if get_origin(annotation) in (Union, types.UnionType):
        (present,) = (part for part in get_args(annotation) if part is not types.NoneType)
        return present, True
    return annotation, False


def _data_type(name: str, annotation: Any) -> DataType:
    metadata: list[Any] = []
    if get_origin(annotation) is Annotated:
        annotation, *metadata = get_args(annotation)
    if get_origin(annotation) is Literal or (isinstance(annotation, type) and issubclass(annotation, StrEnum)):
        return "text"
    if annotation is int and any(isinstance(part, PlainSerializer) for part in metadata):
        return "uint64"  # that of Int64, which has no sign
    data_types: dict[Any, DataType] = {int: "int64", float: "float64", bool: "bool", str: "text"}
    if annotation not in data_types:
        raise ValueError(f"{name} is {annotation}, which is no column")
    return data_types[annotation]


def _follow(*steps: str | int) -> Get:
    """Return a function that follows attributes and indices from a message; None where one on the way is None."""

    def get(part: Any) -> Value:
        for step in steps:
            if part is None:
                return None
            part = part[step] if isinstance(step, int) else getattr(part, step)
        value: Value = part
        return value

    return get


_NOTHING_PRESSES: Final = "; missing where nothing presses on the site"
_NO_COLUMNS: Final = (
    "compensation",
    "suspect_sites",
)  # fields without a column; the reason names the second

Row = Sequence[Value]
_MakeTable = Callable[[Plate, payloads.Message | None], "Table"]


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
        items: Callable[[Any], Sequence[payloads.Message]] | None = None,
    ) -> None:
        self._get = tuple(source.get for source in per_message)
        self._get_of_item = tuple(source.get for source in per_item)
        self._items = items
        nullable = (replace(source.column, nullable=True) for source in per_item)
        self.columns: tuple[Column, ...] = (*(source.column for source in per_message), *nullable)

    def rows(self, message: payloads.Message) -> Iterator[Row]:
        """Give the rows of a message, values in the order of the columns."""
        values = [get(message) for get in self._get]
        if self._items is None:
            yield values
            return
        for item in self._items(message):
            yield [*values, *(get(item) for get in self._get_of_item)]
        if not self._items(message):
            yield [*values, *(None for _ in self._get_of_item)]


def make_table(topic: topics.Topic[Any], plate: Plate, first: payloads.Message | None) -> Table:
    """Return the table of a topic; arrays have the shapes of those in its first message."""
    return _MAKE[topic.path](plate, first)


def _forces(plate: Plate, _first: payloads.Message | None) -> Table:
    values = [*sources(payloads.Forces, skip=("sites", "beats")), *map(_beats, range(len(plate.transducers_m)))]
    return Table([*values, *(source for site in plate.site_ids for source in _of_site(int(site)))])


def _of_site(site: int) -> Iterator[Source]:
    for source in sources(payloads.SiteForce, prefix=f"site_{site}_", skip=("site",)):
        column, get = source.column, source.get

        def of_message(message: payloads.Forces, get: Callable[[payloads.SiteForce], Value] = get) -> Value:
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
    def get(message: payloads.State) -> Value:
        common_mode = message.compensation.common_mode if message.compensation is not None else ()
        return common_mode[channel] if channel < len(common_mode) else None

    description = payloads.Compensation.model_fields["common_mode"].description or ""
    name = f"compensation_channel_{channel}_common_mode"
    return Source(Column(name, "float64", True, (), description, NO_UNIT), get)


def _sensor_state(plate: Plate, _first: payloads.Message | None) -> Table:
    of_part = sources(payloads.Compensation, prefix="compensation_", skip=("common_mode",), within=("compensation",))
    return Table(
        [
            *sources(payloads.State, skip=_NO_COLUMNS),
            *map(_common_mode, range(len(plate.transducers_m))),
            *(replace(source, column=replace(source.column, nullable=True)) for source in of_part),
        ]
    )


def _plain(model: type[payloads.Message], items: str = "", item: type[payloads.Message] | None = None) -> _MakeTable:
    """Return what makes the table of a kind of message, with a row for each of its items if it has many."""
    per_message = list(sources(model, skip=(items,)))
    if item is None:
        return lambda _plate, _first: Table(per_message)
    per_item = list(sources(item, prefix=f"{item.__name__.lower()}_"))
    return lambda _plate, _first: Table(per_message, per_item, attrgetter(items))


def _with_arrays(model: type[payloads.Message], *keys: str) -> _MakeTable:
    """Return what makes the table of a kind of message with arrays, whose shapes are those of the first message."""
    return lambda _plate, first: Table([*sources(model, skip=keys), *(array_sources(first, keys) if first else ())])


_MAKE: Final[Mapping[str, _MakeTable]] = {
    topics.FORCES.path: _forces,
    topics.CONTACTS.path: _plain(payloads.Contacts, "contacts", payloads.Contact),
    topics.CONTACT_EVENT.path: _plain(payloads.ContactEvent),
    topics.SIGNALS.path: _with_arrays(payloads.Signals, "signals", "noise_std"),
    topics.DECODED.path: _with_arrays(payloads.Decoded, "traction_pascal", "traction_std_pascal", "displacement_m"),
    topics.DECODED_SUMMARY.path: _plain(payloads.DecodedSummary, "patches", payloads.Patch),
    topics.STATE_LINK.path: lambda *_: Table(list(sources(payloads.State, skip=_NO_COLUMNS))),
    topics.STATE_SENSOR.path: _sensor_state,
}
WITH_TABLE: Final = tuple(_MAKE)
"""Paths of the topics that have a table."""
WITH_ARRAYS: Final = (topics.SIGNALS.path, topics.DECODED.path)
"""Those whose tables have arrays."""
