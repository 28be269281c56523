"""One whole message of each topic and command, as the AsyncAPI document and docs/reference/mqtt-topics.md show them."""

import json
from pathlib import Path
from types import NoneType
from typing import Any, Final, Literal, TypeVar, get_args, get_origin

import numpy as np
from pydantic import BaseModel

from resonator_daemon.mqtt.codec import encode, read_arrays
from resonator_daemon.mqtt.payload_types import UNITS
from resonator_daemon.mqtt.payloads import WITH_ARRAYS, ContactEvent, Message
from resonator_daemon.mqtt.topics import DECODER_HEALTH, DECODER_STATE, SCHEMA_VERSION, TOPICS
from resonator_daemon.mqtt.verbs import VERBS, Refusal

# Value of each key in all messages, or in one model. A key without one has the value of what has not happened.
# Numbers in arrays are exact as float32: those of four sites, and a map of 2 x 2 pixels.
_VALUES: Final[dict[str, Any]] = {
    "schema_version": SCHEMA_VERSION,
    "units": UNITS,
    **json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8")),
}

# The contact of the examples is on a force site.
_OF_SKINS: Final = {
    *("slip_margin", "slip_margin_std", "slip_margin_systematic", "friction_coefficient"),
    *("friction_coefficient_std", "friction_coefficient_systematic"),
}

ModelT = TypeVar("ModelT", bound=BaseModel)


def _example(kind: type[ModelT]) -> ModelT:
    """Return a message with a value for each key of a model."""
    return kind.model_validate({key: _value(kind, key) for key in kind.model_fields if key not in _OF_SKINS})


def _value(kind: type[BaseModel], key: str) -> Any:
    for name in (*(f"{base.__name__}.{key}" for base in kind.__mro__), key):
        if name in _VALUES:
            value = _VALUES[name]
            return np.array(value) if kind in WITH_ARRAYS and isinstance(value, list) else value
    annotation: Any = kind.model_fields[key].annotation
    parts = get_args(annotation)
    if NoneType in parts:
        return None
    if get_origin(annotation) is Literal:
        return parts[0]
    if parts and get_origin(annotation) is tuple and issubclass(parts[0], BaseModel):
        return (_example(parts[0]),)
    empty = get_origin(annotation) or annotation
    return _example(empty) if issubclass(empty, BaseModel) else empty()


def _json(message: BaseModel, *, exclude_none: bool = False) -> dict[str, Any]:
    fields: dict[str, Any] = json.loads(message.model_dump_json(exclude_none=exclude_none))
    return fields


def _with_rows(kind: type[Message]) -> dict[str, Any]:
    """Return the fields of a CBOR message with arrays as nested rows."""
    fields = read_arrays(encode(_example(kind)))
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in fields.items()}


_VALUES["EventsAnswer.events"] = (_example(ContactEvent).model_copy(update={"replayed": True}),)

_KINDS: Final = [*(topic.payload for topic in TOPICS.values()), DECODER_STATE.payload, DECODER_HEALTH.payload]
_ANSWERS: Final[list[type[BaseModel]]] = [*(verb.answer for verb in VERBS.values()), Refusal]

Examples = dict[str, dict[str, Any]]
EXAMPLES: Final[Examples] = {kind.__name__: _json(_example(kind)) for kind in _KINDS if kind not in WITH_ARRAYS}
ARRAY_EXAMPLES: Final[Examples] = {kind.__name__: _with_rows(kind) for kind in WITH_ARRAYS}
REQUEST_EXAMPLES: Final[Examples] = {
    verb.request.__name__: _json(_example(verb.request), exclude_none=True) for verb in VERBS.values()
}
ANSWER_EXAMPLES: Final[Examples] = {kind.__name__: _json(_example(kind)) for kind in _ANSWERS}
