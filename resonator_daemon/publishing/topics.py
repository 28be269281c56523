"""The topics below `prefix/name/`: what each carries, with which quality of service, and whether it is retained."""

from dataclasses import dataclass
from typing import Final, Generic, Literal, TypeVar

from resonator_daemon.publishing.payloads import (
    ContactEvent,
    Contacts,
    Decoded,
    DecodedSummary,
    Forces,
    Health,
    Info,
    Message,
    Signals,
    State,
)

MessageT = TypeVar("MessageT", bound=Message)


@dataclass(frozen=True)
class Topic(Generic[MessageT]):
    """One topic; with QoS 1 the broker acknowledges each message, with QoS 0 it is sent once or dropped."""

    path: str
    payload: type[MessageT]
    qos: Literal[0, 1] = 0
    retained: bool = False


STATE_DAEMON: Final = Topic("state/daemon", State, qos=1, retained=True)
STATE_LINK: Final = Topic("state/link", State, qos=1, retained=True)
STATE_SENSOR: Final = Topic("state/sensor", State, qos=1, retained=True)
INFO: Final = Topic("info", Info, qos=1, retained=True)
CONTACT_EVENT: Final = Topic("contacts/event", ContactEvent, qos=1)
FORCES: Final = Topic("forces", Forces)
CONTACTS: Final = Topic("contacts", Contacts)
SIGNALS: Final = Topic("signals", Signals)
DECODED: Final = Topic("decoded", Decoded)
DECODED_SUMMARY: Final = Topic("decoded/summary", DecodedSummary)
HEALTH: Final = Topic("health", Health)

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
        SIGNALS,
        DECODED,
        DECODED_SUMMARY,
        HEALTH,
    )
}


def full_topic(prefix: str, name: str, path: str) -> str:
    return f"{prefix}/{name}/{path}"


def split_topic(prefix: str, topic: str) -> tuple[str, str]:
    """Take a full topic below the prefix apart into the plate's name and the path."""
    name, _, path = topic.removeprefix(f"{prefix}/").partition("/")
    return name, path
