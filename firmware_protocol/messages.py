"""Messages that are lists of tagged fields: their tables, and the one codec that reads and writes them."""

import re
from dataclasses import MISSING, dataclass, fields
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
    FAULT = 5
    OTHER_VERSION = 6


class ResetCause(IntEnum):
    """Why the board began anew."""

    UNKNOWN = 0
    POWER_ON = 1
    BROWN_OUT = 2
    WATCHDOG = 3
    SOFTWARE = 4
    RESET_PIN = 5


class LogLevel(IntEnum):
    """How grave a line of the board's log is."""

    DEBUG = 10
    INFO = 20
    WARNING = 30
    ERROR = 40


LEAST_CREDIT_BYTES = 64  # what every board takes, and all that a host sends before IDENTITY


@dataclass(frozen=True, slots=True)
class Identity:
    """Who the board is."""

    product: str
    serial_number: str
    firmware: str
    protocol_minor: int
    credit_bytes: int = LEAST_CREDIT_BYTES
    reset_cause: int = ResetCause.UNKNOWN


@dataclass(frozen=True, slots=True)
class Description:
    """Kind and limits of the board's counter."""

    counter_kind: int
    channels: int
    tones: int
    reference_millihertz: int
    gate_ticks_min: int
    gate_ticks_max: int
    plate: str
    oscillator_millihertz: int = 0
    oscillator_spacing_millihertz: int = 0
    queue_bytes: int | None = None
    capabilities: int = 0
    gate_ticks_step: int = 1

    @property
    def oscillators(self) -> int:
        """Number of oscillators that tones are counted against; 0 for a counter that captures a tone."""
        return self.tones if self.counter_kind == CounterKind.CHANNELISED else 0


@dataclass(frozen=True, slots=True)
class Configuration:
    """How the board shall count."""

    gate_ticks: int


@dataclass(frozen=True, slots=True)
class BoardStatus:
    """What the board reports of itself."""

    frames_dropped: int
    temperature_millikelvin: int | None = None
    bytes_discarded: int | None = None


@dataclass(frozen=True, slots=True)
class BoardLog:
    """A line of text from the board, for a person."""

    level: int
    text: str


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why the board did not do what it was asked."""

    code: int
    text: str


class TaggedField(NamedTuple):
    """One field of a message: its number on the wire, its name with unit, and whether it is a text or a number."""

    tag: int
    name: str
    is_text: bool


MESSAGE_FIELDS: dict[type[Any], tuple[TaggedField, ...]] = {
    kind: tuple(TaggedField(tag, field.name, field.type is str) for tag, field in enumerate(fields(kind), 1))
    for kind in (Identity, Description, Configuration, BoardStatus, BoardLog, Refusal)
}
"""Fields of each message: their tags count from 1 in the order of the class."""

# A field whose attribute has a default may be absent, which means that default.
OPTIONAL_FIELDS: dict[type[Any], frozenset[str]] = {
    kind: frozenset(field.name for field in fields(kind) if field.default is not MISSING) for kind in MESSAGE_FIELDS
}

_MAX_VALUE_BYTES = 255
_MAX_NUMBER_BYTES = 8

Message = TypeVar("Message", Identity, Description, Configuration, BoardStatus, BoardLog, Refusal)


def encode_message(message: Identity | Description | Configuration | BoardStatus | BoardLog | Refusal) -> bytes:
    """Return the payload; text longer than a field may be is cut at a character, what is None is left out."""
    parts = []
    for field in MESSAGE_FIELDS[type(message)]:
        value = getattr(message, field.name)
        if value is None:
            continue
        raw = _text(value) if field.is_text else _number(value)
        parts.append(bytes((field.tag, len(raw))) + raw)
    return b"".join(parts)


def _number(value: int) -> bytes:
    return value.to_bytes(max(1, (value.bit_length() + 7) // 8), "little")


def _text(value: str) -> bytes:
    return value.encode()[:_MAX_VALUE_BYTES].decode(errors="ignore").encode()


_STEERING = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")  # controls, separators, directions


def _printable(text: str) -> str:
    """Return the text with signs that would steer a terminal or end a line of a log replaced."""
    return _STEERING.sub("\N{REPLACEMENT CHARACTER}", text)


def decode_message(kind: type[Message], payload: bytes) -> Message:
    """Return the message in a payload; fields with unknown tags are skipped, unprintable signs replaced.

    Raises
    ------
    MalformedMessageError
        If a field is cut off, has an impossible size or a required one is missing.
    """
    table = {field.tag: field for field in MESSAGE_FIELDS[kind]}
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
        if field.is_text:
            values[field.name] = _printable(raw.decode(errors="replace"))
        elif 1 <= size <= _MAX_NUMBER_BYTES:
            values[field.name] = int.from_bytes(raw, "little")
        else:
            raise MalformedMessageError(f"{field.name} must have 1 to {_MAX_NUMBER_BYTES} bytes, got {size}")
    if missing := [field.name for field in table.values() if field.name not in {*values, *OPTIONAL_FIELDS[kind]}]:
        raise MalformedMessageError(f"missing {', '.join(missing)}")
    return kind(**values)
