"""What is packed once for all messages of a topic: the library would pack properties and headers again for each.

Packets are those of MQTT 5, section 3.3.
"""

from functools import cache
from typing import Final, NamedTuple

from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import JSON, SCHEMA_VERSION, Topic

_TEXT: Final = 1  # payload format indicator: UTF-8
_PUBLISH: Final = PacketTypes.PUBLISH << 4  # QoS 0, not retained


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


class Packet(NamedTuple):
    """A message as it goes to the broker."""

    topic: str
    payload: bytes
    properties: PackedProperties

    @property
    def size_bytes(self) -> int:
        return len(self.payload)


class StreamPackets:
    """Packets of QoS 0 of one stream, for several in one send. Headers differ in their length alone.

    Parameters
    ----------
    topic
    properties
        Left out where the broker supports MQTT 3.1.1 only.
    perishable
        Whether a late message is of no use.
    """

    def __init__(self, topic: str, properties: PackedProperties, *, perishable: bool) -> None:
        name = topic.encode()
        head = len(name).to_bytes(2, "big") + name
        self.topic = topic
        self.perishable = perishable
        self._head_5, self._head_3 = head + properties.pack(), head

    def packet(self, payload: bytes, *, is_mqtt_5: bool) -> bytes:
        """Return a whole packet."""
        head = self._head_5 if is_mqtt_5 else self._head_3
        fixed, remaining_bytes = [_PUBLISH], len(head) + len(payload)
        while remaining_bytes > 0x7F:
            fixed.append(remaining_bytes & 0x7F | 0x80)
            remaining_bytes >>= 7
        fixed.append(remaining_bytes)
        return b"".join((bytes(fixed), head, payload))
