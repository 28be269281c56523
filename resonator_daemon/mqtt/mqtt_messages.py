"""MQTT messages as the clients take and give them, before or after anything is read into them."""

from typing import NamedTuple


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
