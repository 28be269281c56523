"""The columns that a message's fields become: named, with units, and of one type each; their values as arrays."""

import types
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainSerializer
from pydantic.fields import FieldInfo

from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.units import AXES, unit_of, with_axis

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
    model: type[Message], *, prefix: str = "", skip: tuple[str, ...] = (), within: tuple[str, ...] = ()
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


def array_sources(message: Message, keys: tuple[str, ...]) -> Iterator[Source]:
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
    if isinstance(bare, type) and issubclass(bare, Message):
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


_DTYPES: Final = {
    "int64": "<i8",
    "uint64": "<u8",
    "float64": "<f8",
    "bool": "|b1",
    "float32 array": "<f4",
    "text": "<u4",  # the number of the text
}


class ColumnEncoder:
    """Encoder of one column, batch after batch: text by its number, what is missing as NaN, 0 or False.

    Attributes
    ----------
    dtype : numpy.dtype
        Of the arrays.
    texts : dict of str to int, or None
        Number of each text so far, the empty one where it is missing; None for numbers.
    """

    def __init__(self, column: Column) -> None:
        self.dtype = np.dtype(_DTYPES[column.data_type])
        self.texts: dict[str, int] | None = {} if column.data_type == "text" else None
        self._shape = column.shape

    def encode(self, values: Sequence[Value]) -> NDArray[Any]:
        """Return an array of shape (n, ...) for n values."""
        array: NDArray[Any] = np.zeros((len(values), *self._shape), self.dtype)
        if self.texts is not None:
            words = ("" if value is None else str(value) for value in values)
            array[:] = [self.texts.setdefault(word, len(self.texts)) for word in words]
            return array
        if np.issubdtype(self.dtype, np.floating):
            array[...] = np.nan
        for index, value in enumerate(values):
            if value is not None:
                array[index] = value
        return array
