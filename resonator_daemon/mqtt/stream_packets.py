"""PUBLISH packets of QoS 0 in their form on the wire (MQTT 5, section 3.3), for several messages in one send."""

from typing import Final

from paho.mqtt.packettypes import PacketTypes

from resonator_daemon.mqtt.packed_properties import PackedProperties

_PUBLISH: Final = PacketTypes.PUBLISH << 4  # QoS 0, not retained


class StreamPackets:
    """Packets of one stream, whose headers differ in their length alone.

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
        return b"".join((_fixed_header(len(head) + len(payload)), head, payload))


def _fixed_header(remaining_bytes: int) -> bytes:
    header = [_PUBLISH]
    while remaining_bytes > 0x7F:
        header.append(remaining_bytes & 0x7F | 0x80)
        remaining_bytes >>= 7
    header.append(remaining_bytes)
    return bytes(header)
