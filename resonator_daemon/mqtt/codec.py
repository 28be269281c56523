"""Payloads to bytes and back: JSON, or for messages with arrays CBOR with typed arrays (RFC 8746)."""

import io
import math
from collections.abc import Callable, Hashable, Mapping
from enum import StrEnum
from functools import cache
from typing import Any, Final, NamedTuple, TypeVar, cast

import cbor2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel
from pydantic_core import SchemaSerializer

from resonator_daemon.mqtt.payloads import WITH_ARRAYS, Measured, Message

_TAG_ARRAY: Final = 40  # multi-dimensional array, row-major: [shape, elements]
_TAG_FLOAT32: Final = 85  # typed array of little-endian IEEE 754 binary32
_DIMENSIONS_MAX: Final = 3

MessageT = TypeVar("MessageT", bound=Message)


class Incoming(NamedTuple):
    """A message as it came; the last two are MQTT 5's, None where the sender gave none."""

    topic: str
    payload: bytes
    retained: bool
    response_topic: str | None
    correlation: bytes | None


class Outgoing(NamedTuple):
    """A message on its way, QoS 1; the correlation data go with MQTT 5 alone."""

    topic: str
    payload: bytes
    correlation: bytes | None = None
    retained: bool = False
    expiry_s: int | None = None


class Encoded(NamedTuple):
    """A measured message in its encoded form."""

    payload: bytes
    t_ns: int  # of its header, UTC


def encode(message: Message | Encoded) -> bytes:
    """Return the payload as published: CBOR for Signals and Decoded, JSON for all others."""
    if isinstance(message, Encoded):
        return message.payload
    if isinstance(message, WITH_ARRAYS):
        return cbor2.dumps(_fields(message))
    return message.model_dump_json().encode()


def encode_fields(kind: type[Measured], fields: Mapping[str, Any]) -> Encoded:
    """Encode a JSON message given as its fields, parts of it as mappings and tuples.

    The result is that of the model if `fields` has no optional key without a value. A model of each message would take
    as long as all other work on it. Values of another type are refused; a field that is missing is not noticed here,
    but in the tests of each message.
    """
    return Encoded(_serializer_of_fields(kind).to_json(fields, warnings="error"), fields["t_ns"])


@cache
def _serializer_of_fields(kind: type[Message]) -> SchemaSerializer:
    return SchemaSerializer(_schema_of_mappings(kind.__pydantic_core_schema__))


def _schema_of_mappings(schema: Any) -> Any:
    """Return the schema of a model with a mapping instead of each model in it."""
    if isinstance(schema, list):
        return [_schema_of_mappings(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    if schema.get("type") == "model":
        return _schema_of_mappings(schema["schema"])
    parts = {
        key: _schema_of_mappings(part)
        for key, part in schema.items()
        if key not in ("model_name", "serialization_exclude_if")
    }
    kinds = {"model-fields": "typed-dict", "model-field": "typed-dict-field"}
    return parts | {"type": kinds.get(parts["type"], parts["type"])} if isinstance(parts.get("type"), str) else parts


def decoded(topic_payload: type[MessageT], message: MessageT | Encoded) -> MessageT:
    """Return a message that may be encoded as its model."""
    return decode(topic_payload, message.payload) if isinstance(message, Encoded) else message


def decode(kind: type[MessageT], payload: bytes) -> MessageT:
    """Read a payload of a topic that carries `kind`; arrays are read-only.

    Raises
    ------
    ValueError
        The payload is not a well-formed message of this kind.
    """
    if not issubclass(kind, WITH_ARRAYS):
        return kind.model_validate_json(payload)
    return kind.model_validate(read_arrays(payload))


def read_arrays(payload: bytes) -> Any:
    """Return the fields of a CBOR payload, not checked against a model; arrays are read-only.

    Raises
    ------
    ValueError
        The payload is not CBOR, or not one object.
    """
    stream = io.BytesIO(payload)
    try:
        fields = cbor2.CBORDecoder(stream, tag_hook=_read_tag).decode()
    except cbor2.CBORDecodeError as error:
        raise ValueError(f"not CBOR: {error.__cause__ or error}") from error
    if trailing := len(stream.read()):
        raise ValueError(f"{trailing} bytes after the CBOR message")
    return fields


def _fields(message: BaseModel) -> dict[str, Any]:
    """Return the fields of a model as CBOR has them; the encoder looks up each other type again in every message."""
    omits = _omits(cast(Hashable, type(message)))
    fields: dict[str, Any] = {}
    for name, value in message.__dict__.items():
        if name in omits and omits[name](value):
            continue
        if isinstance(value, np.ndarray):
            value = cbor2.CBORTag(_TAG_ARRAY, [value.shape, cbor2.CBORTag(_TAG_FLOAT32, value.tobytes())])
        elif isinstance(value, StrEnum):
            value = str(value)
        elif isinstance(value, BaseModel):
            value = _fields(value)
        fields[name] = value
    return fields


@cache
def _omits(kind: Any) -> dict[str, Callable[[Any], bool]]:
    """Return the optional keys of a model, each with the function that finds it without a value."""
    return {name: field.exclude_if for name, field in kind.model_fields.items() if field.exclude_if is not None}


def _read_tag(tag: cbor2.CBORTag, _immutable: bool = False) -> Any:
    if tag.tag == _TAG_FLOAT32:
        if not isinstance(tag.value, bytes) or len(tag.value) % 4:
            raise ValueError("a float32 array must be a byte string of a multiple of 4 bytes")
        return np.frombuffer(tag.value, "<f4")
    if tag.tag == _TAG_ARRAY:
        return _shaped(tag.value)
    return tag


def _shaped(value: Any) -> NDArray[np.float32]:
    match value:
        case [[*shape], np.ndarray() as elements] if 0 < len(shape) <= _DIMENSIONS_MAX:
            if all(type(size) is int and size >= 0 for size in shape) and math.prod(shape) == elements.size:
                return elements.reshape(shape)
            raise ValueError(f"{elements.size} elements do not fill the shape {shape}")
    raise ValueError("an array must be [shape, float32 elements], of at most 3 dimensions")
