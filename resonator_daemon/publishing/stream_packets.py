"""PUBLISH packets of QoS 0 in their form on the wire (MQTT 5, section 3.3), for several messages in one send."""

from functools import lru_cache
from typing import Final

from paho.mqtt.packettypes import PacketTypes

from resonator_daemon.publishing.packed_properties import PackedProperties

_PUBLISH: Final = PacketTypes.PUBLISH << 4  # QoS 0, not retained
_TOPICS: Final = 64  # whose headers are kept; a daemon has fewer streams


def stream_packet(topic: str, properties: PackedProperties | None, payload: bytes) -> bytes:
    """Return the whole packet; `properties` is None where the broker speaks MQTT 3.1.1."""
    head = _variable_header(topic, properties)
    return b"".join((_fixed_header(len(head) + len(payload)), head, payload))


@lru_cache(_TOPICS)
def _variable_header(topic: str, properties: PackedProperties | None) -> bytes:
    name = topic.encode()
    return len(name).to_bytes(2, "big") + name + (properties.pack() if properties is not None else b"")


def _fixed_header(remaining_bytes: int) -> bytes:
    header = bytearray((_PUBLISH,))
    while remaining_bytes > 0x7F:
        header.append(remaining_bytes & 0x7F | 0x80)
        remaining_bytes >>= 7
    header.append(remaining_bytes)
    return bytes(header)
