"""Messages that are lists of tagged fields: their tables, and the one codec that reads and writes them."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, TypeVar


class MalformedMessageError(ValueError):
    """The payload of a sound packet is not the message that its type announces."""


class CounterKind(IntEnum):
    """What a board counts on each channel."""

    SINGLE_TONE = 0  # one captured tone
    CHANNELISED = 1  # all tones at once


class RefusalCode(IntEnum):
    """Why a board refuses a request."""

    MALFORMED = 1
    UNKNOWN_MESSAGE = 2
    NOT_IN_THIS_STATE = 3
    OUT_OF_RANGE = 4


@dataclass(frozen=True, slots=True)
class Identity:
    """Who the board is."""

    product: str
    serial_number: str
    firmware: str
    protocol_minor: int


@dataclass(frozen=True, slots=True)
class Description:
    """What the board counts and within which limits."""

    counter_kind: int
    channels: int
    tones: int
    reference_millihertz: int
    gate_ticks_min: int
    gate_ticks_max: int
    plate: str
    oscillator_millihertz: int = 0
    oscillator_spacing_millihertz: int = 0


@dataclass(frozen=True, slots=True)
class Configuration:
    """How the board shall count."""

    gate_ticks: int


@dataclass(frozen=True, slots=True)
class BoardStatus:
    """What the board reports of itself."""

    frames_dropped: int
    temperature_millikelvin: int | None = None


@dataclass(frozen=True, slots=True)
class BoardLog:
    """A line that the board wants a person to read."""

    level: int
    text: str


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why the board did not do what it was asked."""

    code: int
    text: str


class _Tagged(NamedTuple):
    tag: int
    name: str
    kind: type[int] | type[str]
    required: bool = True


_FIELDS: dict[type[Any], tuple[_Tagged, ...]] = {
    Identity: (
        _Tagged(1, "product", str),
        _Tagged(2, "serial_number", str),
        _Tagged(3, "firmware", str),
        _Tagged(4, "protocol_minor", int),
    ),
    Description: (
        _Tagged(1, "counter_kind", int),
        _Tagged(2, "channels", int),
        _Tagged(3, "tones", int),
        _Tagged(4, "reference_millihertz", int),
        _Tagged(5, "gate_ticks_min", int),
        _Tagged(6, "gate_ticks_max", int),
        _Tagged(7, "plate", str),
        _Tagged(8, "oscillator_millihertz", int, required=False),
        _Tagged(9, "oscillator_spacing_millihertz", int, required=False),
    ),
    Configuration: (_Tagged(1, "gate_ticks", int),),
    BoardStatus: (_Tagged(1, "frames_dropped", int), _Tagged(2, "temperature_millikelvin", int, required=False)),
    BoardLog: (_Tagged(1, "level", int), _Tagged(2, "text", str)),
    Refusal: (_Tagged(1, "code", int), _Tagged(2, "text", str)),
}

_MAX_VALUE_BYTES = 255
_MAX_NUMBER_BYTES = 8

Message = TypeVar("Message", Identity, Description, Configuration, BoardStatus, BoardLog, Refusal)


def encode_message(message: Identity | Description | Configuration | BoardStatus | BoardLog | Refusal) -> bytes:
    """Return the payload; text longer than a field may be is cut at a character."""
    parts = []
    for field in _FIELDS[type(message)]:
        value = getattr(message, field.name)
        if value is None:
            continue
        raw = _number(value) if field.kind is int else _text(value)
        parts.append(bytes((field.tag, len(raw))) + raw)
    return b"".join(parts)


def _number(value: int) -> bytes:
    return value.to_bytes(max(1, (value.bit_length() + 7) // 8), "little")


def _text(value: str) -> bytes:
    return value.encode()[:_MAX_VALUE_BYTES].decode(errors="ignore").encode()


def decode_message(kind: type[Message], payload: bytes) -> Message:
    """Return the message in a payload; fields with unknown tags are skipped.

    Raises
    ------
    MalformedMessageError
        If a field is cut off, has an impossible size or a required one is missing.
    """
    table = {field.tag: field for field in _FIELDS[kind]}
    values: dict[str, Any] = {}
    position = 0
    while position < len(payload):
        if position + 2 > len(payload) or position + 2 + payload[position + 1] > len(payload):
            raise MalformedMessageError(f"field at byte {position} is cut off")
        tag, size = payload[position], payload[position + 1]
        raw = payload[position + 2 : position + 2 + size]
        position += 2 + size
        if (field := table.get(tag)) is None:
            continue
        if field.kind is str:
            values[field.name] = raw.decode(errors="replace")
        elif 1 <= size <= _MAX_NUMBER_BYTES:
            values[field.name] = int.from_bytes(raw, "little")
        else:
            raise MalformedMessageError(f"{field.name} must have 1 to {_MAX_NUMBER_BYTES} bytes, got {size}")
    if missing := [field.name for field in table.values() if field.required and field.name not in values]:
        raise MalformedMessageError(f"missing {', '.join(missing)}")
    return kind(**values)
