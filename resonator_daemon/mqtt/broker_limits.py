"""Limits of a broker: those it declares when it accepts a connection, and those it shows by ending one."""

from collections import deque
from collections.abc import Iterable
from typing import Any, Final, NamedTuple, Protocol

SUSPECT_BYTES_MIN: Final = 1024
SUSPECT_S: Final = 2.0
EXPIRY_S: Final = 600.0  # then one more message of that size is tried: the broker's limit may have been raised

_PACKET_BYTES_MAX: Final = 268_435_455 + 5  # largest that MQTT can encode
_FIXED_BYTES: Final = 5  # at most: type and remaining length


class BrokerLimits(NamedTuple):
    """Limits of one connection; where the broker declares none, those of the protocol."""

    receive_maximum: int = 65_535  # messages of QoS 1 that are not acknowledged
    packet_bytes_max: int = _PACKET_BYTES_MAX
    qos_max: int = 2
    retains: bool = True

    def within(self, other: "BrokerLimits") -> "BrokerLimits":
        """Return what both allow."""
        return BrokerLimits(
            min(self.receive_maximum, other.receive_maximum),
            min(self.packet_bytes_max, other.packet_bytes_max),
            min(self.qos_max, other.qos_max),
            self.retains and other.retains,
        )


def limits_of(connack: Any) -> BrokerLimits:
    """Read the limits from the properties of CONNACK; None with MQTT 3.1.1."""
    default = BrokerLimits()
    return BrokerLimits(
        getattr(connack, "ReceiveMaximum", default.receive_maximum),
        getattr(connack, "MaximumPacketSize", default.packet_bytes_max),
        getattr(connack, "MaximumQoS", default.qos_max),
        bool(getattr(connack, "RetainAvailable", default.retains)),
    )


def packet_bytes(topic: str, payload_bytes: int, qos: int, properties_bytes: int) -> int:
    """Return the size of a PUBLISH packet, or up to 3 bytes more."""
    return _FIXED_BYTES + 2 + len(topic.encode()) + 2 * qos + properties_bytes + payload_bytes


class SentMessage(Protocol):
    """A message that was written to the socket."""

    @property
    def topic(self) -> str: ...

    @property
    def size_bytes(self) -> int: ...


class _Largest(NamedTuple):
    """A message larger than all before it."""

    serial: int
    size_bytes: int
    topic: str
    sent_s: float


class LargestMessages:
    """Detects that a broker ends the connection upon messages that are too large without announcing a limit.

    If any message of a connection is too large, the largest one is. It is suspected where the connection ends within
    2 s after it, it is larger than all that the broker is known to have taken, and nothing sent later was
    acknowledged. Where two connections in a row end so, with a broker that was there again at once, messages as large
    as the smaller of the two suspects are not sent any more, for a while.
    """

    def __init__(self) -> None:
        self._serial = 0
        self._largest: deque[_Largest] = deque()  # rising in size, not known to be taken
        self._awaited: deque[int] = deque()  # serial numbers of what is to be acknowledged
        self._received_bytes = 0
        self._suspect: _Largest | None = None
        self.limit_bytes = _PACKET_BYTES_MAX
        self._since_s = 0.0

    def bytes_max(self, now_s: float) -> int:
        """Return the largest size of a packet that may be sent: `limit_bytes` until that expires."""
        if now_s - self._since_s > EXPIRY_S:
            self.limit_bytes = _PACKET_BYTES_MAX
        return self.limit_bytes

    def connected(self, *, at_once: bool) -> None:
        """Begin a connection; `at_once`: by the first attempt since the last one ended, else the broker was away."""
        self._largest.clear()
        self._awaited.clear()
        if not at_once:  # another broker may be there, or this one with another limit
            self._suspect = None
            self.limit_bytes = _PACKET_BYTES_MAX
            self._received_bytes = 0

    def sent(self, messages: Iterable[SentMessage], now_s: float, *, awaited: bool = False) -> None:
        """Count messages; `awaited`: the broker will acknowledge them."""
        largest_bytes = self._largest[-1].size_bytes if self._largest else self._received_bytes
        for message in messages:
            self._serial += 1
            if message.size_bytes > largest_bytes:
                largest_bytes = message.size_bytes
                self._largest.append(_Largest(self._serial, largest_bytes, message.topic, now_s))
            if awaited:
                self._awaited.append(self._serial)

    def acknowledged(self) -> None:
        """Mark the oldest message to be acknowledged, and all before it, as received by the broker."""
        serial = self._awaited.popleft()
        while self._largest and self._largest[0].serial <= serial:
            self._received_bytes = self._largest.popleft().size_bytes

    def ended(self, now_s: float) -> tuple[str, int] | None:
        """End the connection; return topic and size of a message that is too large, when that has become clear."""
        while self._largest and now_s - self._largest[0].sent_s > SUSPECT_S:
            self._received_bytes = self._largest.popleft().size_bytes
        previous, self._suspect = self._suspect, None
        if not self._largest or self._largest[-1].size_bytes < SUSPECT_BYTES_MIN:
            return None
        self._suspect = self._largest[-1]
        if previous is None:
            return None
        smaller = min(previous, self._suspect, key=lambda suspect: suspect.size_bytes)
        self.limit_bytes, self._since_s = smaller.size_bytes - 1, now_s
        return smaller.topic, smaller.size_bytes
