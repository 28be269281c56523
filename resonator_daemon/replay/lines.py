"""Messages as lines of JSON, arrays of CBOR messages as rows of numbers."""

from typing import Any

import numpy as np

from resonator_daemon.publishing.codec import Encoded
from resonator_daemon.publishing.payloads import Message
from resonator_daemon.replay.recorded_pipeline import Published


def payload_json(message: Message | Encoded) -> str:
    """Return what is published as JSON; for a message with arrays, the same keys with rows of numbers."""
    if isinstance(message, Encoded):
        return message.payload.decode()
    return message.model_dump_json(fallback=_rows)


def line(published: Published) -> str:
    """Return topic and payload as one JSON object."""
    return f'{{"topic":"{published.topic.path}","payload":{payload_json(published.message)}}}'


def _rows(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is nothing that messages have")
