"""Differences between decoded messages and those that a recording stores."""

import json
from collections import Counter
from typing import Any, Final

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.mqtt.payloads import ContactEvent, Contacts, Message
from resonator_daemon.mqtt.topics import CONTACT_EVENT, CONTACTS

STORED_TOPICS: Final = (CONTACTS.path, CONTACT_EVENT.path)
SAME_EVENT_NS: Final = 50_000_000  # an event this near, of the same kind and site, is the same
_PENDING_MAX: Final = 4096  # messages of one side that wait for the other
_KINDS: Final = ("onset", "release", "incipient_slip", "gross_slip")

Event = tuple[str, int | None, int]
"""Kind, site and time."""


class Changes:
    """Comparison of stored messages of one chunk with decoded ones.

    Parameters
    ----------
    begin_ns, end_ns
        UTC from and before which stored messages belong to the chunk; None: beginning and end of the recording.
    """

    def __init__(self, begin_ns: int | None, end_ns: int | None) -> None:
        self._begin_ns = begin_ns or 0
        self._end_ns = end_ns or 1 << 63
        self._stored: dict[int, Floats] = {}  # net force by the board's ticks
        self._decoded: dict[int, Floats] = {}
        self._stored_events: list[Event] = []
        self._decoded_events: list[Event] = []
        self._numbers: Counter[str] = Counter()
        self._square_newton2 = 0.0

    def add_stored(self, topic: str, data: bytes, utc_ns: int) -> None:
        """Add a stored payload of a topic of `STORED_TOPICS`; a malformed one is counted as unreadable."""
        belongs = self._begin_ns <= utc_ns < self._end_ns
        try:
            payload = json.loads(data)
            if topic == CONTACTS.path:
                self._numbers["contacts_stored"] += belongs
                force = [_vector(contact["force_newton"]) for contact in payload["contacts"]]
                self._pair(int(payload["board_ticks"]), sum(force, np.zeros(3)), self._stored, self._decoded)
            elif belongs:
                self._stored_events.append((payload["event"], payload["contact"].get("site"), int(payload["t_ns"])))
        except (ValueError, KeyError, TypeError, AttributeError):
            self._numbers["unreadable"] += 1

    def add_decoded(self, message: Message) -> None:
        """Add a message that decoding has made; topics that are not stored are ignored."""
        if isinstance(message, Contacts) and message.board_ticks is not None:
            self._numbers["contacts_decoded"] += 1
            force = [_vector(contact.force_newton) for contact in message.contacts]
            self._pair(message.board_ticks, sum(force, np.zeros(3)), self._decoded, self._stored)
        elif isinstance(message, ContactEvent):
            self._decoded_events.append((message.event, message.contact.site, message.t_ns))

    def _pair(self, ticks: int, force_newton: Floats, own: dict[int, Floats], others: dict[int, Floats]) -> None:
        other = others.pop(ticks, None)
        if other is None:
            own[ticks] = force_newton
            if len(own) > _PENDING_MAX:
                del own[next(iter(own))]
            return
        difference = force_newton - other
        self._numbers["compared"] += 1
        self._square_newton2 += float(np.nansum(difference**2))

    def numbers(self) -> dict[str, float]:
        """Return counts, and the sum of squared differences; all can be added over chunks."""
        both = _matches(self._stored_events, self._decoded_events)
        numbers: dict[str, float] = dict(self._numbers)
        for kind in _KINDS:
            numbers[f"{kind}_stored"] = sum(event[0] == kind for event in self._stored_events)
            numbers[f"{kind}_decoded"] = sum(event[0] == kind for event in self._decoded_events)
            numbers[f"{kind}_both"] = both[kind]
        return numbers | {"square_newton2": self._square_newton2}


def summary(numbers: Counter[str]) -> dict[str, Any] | None:
    """Return the value of `changes` in `--json`, from summed numbers; None if the recordings store no contacts."""
    if not numbers["contacts_stored"]:
        return None
    events = {
        kind: {
            "stored": int(numbers[f"{kind}_stored"]),
            "decoded": int(numbers[f"{kind}_decoded"]),
            "gained": int(numbers[f"{kind}_decoded"] - numbers[f"{kind}_both"]),
            "lost": int(numbers[f"{kind}_stored"] - numbers[f"{kind}_both"]),
        }
        for kind in _KINDS
    }
    compared = int(numbers["compared"])
    return {
        "contacts_stored": int(numbers["contacts_stored"]),
        "contacts_decoded": int(numbers["contacts_decoded"]),
        "compared": compared,
        "force_difference_newton_rms": (numbers["square_newton2"] / compared) ** 0.5 if compared else None,
        "events": events,
    }


def _vector(force_newton: Any) -> Floats:
    """Return a force as an array (3,) in newton; a component that is unknown or not measured counts as 0."""
    return np.nan_to_num(np.array([np.nan if part is None else part for part in force_newton], np.float64))


def _matches(stored: list[Event], decoded: list[Event]) -> Counter[str]:
    """Count pairs of equal stored and decoded events by kind, in the order of time; no event is in two pairs."""
    both: Counter[str] = Counter()
    left = sorted(decoded, key=lambda event: event[2])
    for kind, site, t_ns in sorted(stored, key=lambda event: event[2]):
        for index, (other_kind, other_site, other_ns) in enumerate(left):
            if (other_kind, other_site) == (kind, site) and abs(other_ns - t_ns) <= SAME_EVENT_NS:
                del left[index]
                both[kind] += 1
                break
            if other_ns > t_ns + SAME_EVENT_NS:
                break
    return both
