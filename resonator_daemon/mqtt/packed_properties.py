"""Properties of MQTT 5 in their form on the wire, made once: the library would pack them again for each message."""

from functools import cache
from typing import Final

from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import JSON, SCHEMA_VERSION, Topic

_TEXT: Final = 1  # payload format indicator: UTF-8


class PackedProperties(Properties):
    """Properties in packed form, instead of the library's own; immutable."""

    _packed: bytes

    def __init__(self, properties: Properties) -> None:
        super().__init__(properties.packetType)  # type: ignore[no-untyped-call]
        object.__setattr__(self, "_packed", properties.pack())  # type: ignore[no-untyped-call]

    def pack(self) -> bytes:
        return self._packed


def pack(
    *,
    content_type: str | None = None,
    expiry_s: int | None = None,
    correlation: bytes | None = None,
    response_topic: str | None = None,
    packet_type: int = PacketTypes.PUBLISH,
) -> PackedProperties:
    """Return the given properties packed; with a content type, the version of the schema is added."""
    properties = Properties(packet_type)  # type: ignore[no-untyped-call]
    if content_type is not None:
        properties.ContentType = content_type
        properties.UserProperty = ("schema_version", SCHEMA_VERSION)
        if content_type == JSON:
            properties.PayloadFormatIndicator = _TEXT
    if expiry_s is not None:
        properties.MessageExpiryInterval = expiry_s
    if correlation is not None:
        properties.CorrelationData = correlation
    if response_topic is not None:
        properties.ResponseTopic = response_topic
    return PackedProperties(properties)


@cache
def properties_of(topic: Topic[Message]) -> PackedProperties:
    return pack(content_type=topic.content_type, expiry_s=topic.expiry_s)
