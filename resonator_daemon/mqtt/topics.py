"""The topics below `prefix/name/`: what each carries, how it is sent, and how often at most to people."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Generic, Literal, TypeVar

from resonator_daemon.mqtt.payloads import (
    WITH_ARRAYS,
    ContactEvent,
    Contacts,
    Decoded,
    DecodedSummary,
    DecoderHealth,
    DecoderState,
    Forces,
    Health,
    Info,
    Measured,
    Message,
    Signals,
    State,
    Tones,
)

SCHEMA_VERSION: Final = "2.1"  # of all payloads; minor: keys were added, major: anything else was changed
JSON: Final = "application/json"
CBOR: Final = "application/cbor"

MessageT = TypeVar("MessageT", bound=Message)


@dataclass(frozen=True)
class Topic(Generic[MessageT]):
    """One topic; with QoS 1 the broker acknowledges each message, with QoS 0 it is sent once or dropped.

    Attributes
    ----------
    slow_hz
        Rate of a decimated topic next to it, on `slow_path`; None where there is none.
    rate_max_hz
        Most messages a second of the topic itself; None: as many as there are readings.
    expiry_s
        Time after which a message is of no use, sent to the broker with MQTT 5; None where it stays true.
    """

    path: str
    payload: type[MessageT]
    qos: Literal[0, 1] = 0
    retained: bool = False
    slow_hz: int | None = None
    rate_max_hz: int | None = None
    expiry_s: int | None = None

    @cached_property
    def slow_path(self) -> str:
        return f"{self.path}/{self.slow_hz}hz"

    @cached_property
    def perishable(self) -> bool:
        """Whether a late message is of no use, because the next one replaces it."""
        return issubclass(self.payload, Measured)

    @cached_property
    def content_type(self) -> str:
        return CBOR if self.payload in WITH_ARRAYS else JSON


_STREAM_EXPIRY_S: Final = 10
_HEALTH_EXPIRY_S: Final = 60
DECODER_EXPIRY_S: Final = 3600  # of a decoder that is gone, by when nobody asks for it any more

STATE_DAEMON: Final = Topic("state/daemon", State, qos=1, retained=True)
STATE_LINK: Final = Topic("state/link", State, qos=1, retained=True)
STATE_SENSOR: Final = Topic("state/sensor", State, qos=1, retained=True)
INFO: Final = Topic("info", Info, qos=1, retained=True)
CONTACT_EVENT: Final = Topic("contacts/event", ContactEvent, qos=1)
FORCES: Final = Topic("forces", Forces, slow_hz=20, expiry_s=_STREAM_EXPIRY_S)
CONTACTS: Final = Topic("contacts", Contacts, slow_hz=20, expiry_s=_STREAM_EXPIRY_S)
TONES: Final = Topic("tones", Tones, rate_max_hz=20, expiry_s=_STREAM_EXPIRY_S)
SIGNALS: Final = Topic("signals", Signals, slow_hz=5, expiry_s=_STREAM_EXPIRY_S)
DECODED: Final = Topic("decoded", Decoded, slow_hz=5, expiry_s=_STREAM_EXPIRY_S)
DECODED_SUMMARY: Final = Topic("decoded/summary", DecodedSummary, slow_hz=20, expiry_s=_STREAM_EXPIRY_S)
HEALTH: Final = Topic("health", Health, expiry_s=_HEALTH_EXPIRY_S)

SCHEMA_PATH: Final = "schema"  # retained, QoS 1: the AsyncAPI document of all of this, JSON without a header

TOPICS: Final[dict[str, Topic[Message]]] = {
    topic.path: topic  # type: ignore[misc]
    for topic in (
        STATE_DAEMON,
        STATE_LINK,
        STATE_SENSOR,
        INFO,
        CONTACT_EVENT,
        FORCES,
        CONTACTS,
        TONES,
        SIGNALS,
        DECODED,
        DECODED_SUMMARY,
        HEALTH,
    )
}

# Of a decoder process, below `prefix/decoder/<id>/`.
DECODER_STATE: Final = Topic("state", DecoderState, qos=1, retained=True, expiry_s=DECODER_EXPIRY_S)
DECODER_HEALTH: Final = Topic("health", DecoderHealth, expiry_s=_HEALTH_EXPIRY_S)


def full_topic(prefix: str, name: str, path: str) -> str:
    return f"{prefix}/{name}/{path}"


def split_topic(prefix: str, topic: str) -> tuple[str, str]:
    """Split a full topic below the prefix into the plate's name and the path."""
    name, _, path = topic.removeprefix(f"{prefix}/").partition("/")
    return name, path
