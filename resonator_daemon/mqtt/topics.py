"""The topics below `prefix/name/`: what each carries, how it is sent, how often at most to people, and its headers."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Generic, Literal, TypeVar

from resonator_daemon.mqtt import payloads

SCHEMA_VERSION: Final = "2.1"  # of all payloads; minor: keys were added, major: anything else was changed
JSON: Final = "application/json"
CBOR: Final = "application/cbor"

MessageT = TypeVar("MessageT", bound=payloads.Message)
HeaderFields = dict[str, Any]  # of `BoardHeader` or `Measured`, by name


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
        return issubclass(self.payload, payloads.Measured)

    @cached_property
    def content_type(self) -> str:
        return CBOR if self.payload in payloads.WITH_ARRAYS else JSON


_STREAM_EXPIRY_S: Final = 10
_HEALTH_EXPIRY_S: Final = 60
DECODER_EXPIRY_S: Final = 3600  # of a decoder that is gone, by when nobody asks for it any more

STATE_DAEMON: Final = Topic("state/daemon", payloads.State, qos=1, retained=True)
STATE_LINK: Final = Topic("state/link", payloads.State, qos=1, retained=True)
STATE_SENSOR: Final = Topic("state/sensor", payloads.State, qos=1, retained=True)
INFO: Final = Topic("info", payloads.Info, qos=1, retained=True)
CONTACT_EVENT: Final = Topic("contacts/event", payloads.ContactEvent, qos=1)
FORCES: Final = Topic("forces", payloads.Forces, slow_hz=20, expiry_s=_STREAM_EXPIRY_S)
CONTACTS: Final = Topic("contacts", payloads.Contacts, slow_hz=20, expiry_s=_STREAM_EXPIRY_S)
TONES: Final = Topic("tones", payloads.Tones, rate_max_hz=20, expiry_s=_STREAM_EXPIRY_S)
SIGNALS: Final = Topic("signals", payloads.Signals, slow_hz=5, expiry_s=_STREAM_EXPIRY_S)
DECODED: Final = Topic("decoded", payloads.Decoded, slow_hz=5, expiry_s=_STREAM_EXPIRY_S)
DECODED_SUMMARY: Final = Topic("decoded/summary", payloads.DecodedSummary, slow_hz=20, expiry_s=_STREAM_EXPIRY_S)
HEALTH: Final = Topic("health", payloads.Health, expiry_s=_HEALTH_EXPIRY_S)

SCHEMA_PATH: Final = "schema"  # retained, QoS 1: the AsyncAPI document of all of this, JSON without a header

TOPICS: Final[dict[str, Topic[payloads.Message]]] = {
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
DECODER_STATE: Final = Topic("state", payloads.DecoderState, qos=1, retained=True, expiry_s=DECODER_EXPIRY_S)
DECODER_HEALTH: Final = Topic("health", payloads.DecoderHealth, expiry_s=_HEALTH_EXPIRY_S)


def full_topic(prefix: str, name: str, path: str) -> str:
    return f"{prefix}/{name}/{path}"


def split_topic(prefix: str, topic: str) -> tuple[str, str]:
    """Split a full topic below the prefix into the plate's name and the path."""
    name, _, path = topic.removeprefix(f"{prefix}/").partition("/")
    return name, path


class Headers:
    """Makes the headers of one run of the daemon; numbers the messages of each topic.

    Parameters
    ----------
    name
        Of the plate; empty where it is not known yet.
    daemon_boot_id
        Identifier of the run.
    lost
        Returns the losses as they are when a header is made.

    Attributes
    ----------
    name
        Of the plate; empty before it is known, which no message to a broker shows.
    board_boot_id
        Of the board that counts; None before there is one.
    """

    def __init__(self, name: str, daemon_boot_id: str, lost: Callable[[], payloads.Lost]) -> None:
        self.name = name
        self._daemon_boot_id = daemon_boot_id
        self.lost = lost
        self._seq: Counter[str] = Counter()
        self.board_boot_id: str | None = None

    def of(self, topic: Topic[Any], utc_ns: int) -> HeaderFields:
        """Return the header of a message about a moment on the host's clock."""
        return {
            "name": self.name,
            "seq": self.next_seq(topic),
            "daemon_boot_id": self._daemon_boot_id,
            "t_ns": utc_ns,
            "t_uncertainty_ns": 0,
            "lost": self.lost(),
            "board_boot_id": self.board_boot_id,
        }

    def of_window(self, t_ns: int, t_uncertainty_ns: int, board_ticks: int) -> HeaderFields:
        """Return what headers of messages about a window share: the UTC of its middle, the board's ticks at its end."""
        return {
            "name": self.name,
            "daemon_boot_id": self._daemon_boot_id,
            "t_ns": t_ns,
            "t_uncertainty_ns": t_uncertainty_ns,
            "lost": self.lost(),
            "board_ticks": board_ticks,
        }

    def next_seq(self, topic: Topic[Any]) -> int:
        """Return the next number `seq` of a topic."""
        path = topic.path
        seq = self._seq[path]
        self._seq[path] = seq + 1
        return seq

    def skip(self, *topics: Topic[Any]) -> None:
        """Skip one number `seq` of each topic, for a message that is not made."""
        for topic in topics:
            self._seq[topic.path] += 1
