"""What decoding again changes against the messages that a recording stores."""

import json
from collections import Counter
from typing import Any, Final

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.publishing.payloads import ContactEvent, Contacts, Message
from resonator_daemon.publishing.topics import CONTACT_EVENT, CONTACTS

STORED_TOPICS: Final = (CONTACTS.path, CONTACT_EVENT.path)
SAME_EVENT_NS: Final = 50_000_000  # an event this near, of the same kind and site, is the same
_PENDING_MAX: Final = 4096  # messages of one side that wait for the other
_KINDS: Final = ("onset", "release", "incipient_slip", "gross_slip")

Event = tuple[str, int | None, int]
"""Kind, site and time."""


class Changes:
    """Comparison of messages that are stored with those that are made, of one chunk.

    Parameters
    ----------
    begin_ns, end_ns
        UTC between which stored messages belong to the chunk; None: from the beginning, to the end.
    """

    def __init__(self, begin_ns: int | None, end_ns: int | None) -> None:
        self._begin_ns = begin_ns or 0
        self._end_ns = end_ns or 1 << 63
        self._stored: dict[int, Floats] = {}  # net force by the board's ticks
        self._made: dict[int, Floats] = {}
        self._events: tuple[list[Event], list[Event]] = ([], [])
        self._numbers: Counter[str] = Counter()
        self._square_newton2 = 0.0

    def add_stored(self, topic: str, data: bytes, utc_ns: int) -> None:
        """Add a payload that the recording stores; one that is no such message is counted as unreadable."""
        belongs = self._begin_ns <= utc_ns < self._end_ns
        try:
            payload = json.loads(data)
            if topic == CONTACTS.path:
                self._numbers["contacts_stored"] += belongs
                force = [_vector(contact["force_newton"]) for contact in payload["contacts"]]
                self._pair(int(payload["board_ticks"]), sum(force, np.zeros(3)), self._stored, self._made)
            elif belongs:
                self._events[0].append((payload["event"], payload["contact"].get("site"), int(payload["t_ns"])))
        except (ValueError, KeyError, TypeError, AttributeError):
            self._numbers["unreadable"] += 1

    def add_made(self, message: Message) -> None:
        """Add a message that follows from decoding."""
        if isinstance(message, Contacts) and message.board_ticks is not None:
            self._numbers["contacts_made"] += 1
            force = [_vector(contact.force_newton) for contact in message.contacts]
            self._pair(message.board_ticks, sum(force, np.zeros(3)), self._made, self._stored)
        elif isinstance(message, ContactEvent):
            self._events[1].append((message.event, message.contact.site, message.t_ns))

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
        """Return the numbers of the comparison, which may be added to those of other chunks."""
        stored, made = self._events
        both = _matches(stored, made)
        numbers: dict[str, float] = dict(self._numbers)
        for kind in _KINDS:
            numbers[f"{kind}_stored"] = sum(event[0] == kind for event in stored)
            numbers[f"{kind}_made"] = sum(event[0] == kind for event in made)
            numbers[f"{kind}_both"] = both[kind]
        return numbers | {"square_newton2": self._square_newton2}


def summary(numbers: Counter[str]) -> dict[str, Any] | None:
    """Return what has changed by the keys of `--json`; None if the recordings store nothing to compare with."""
    if not numbers["contacts_stored"]:
        return None
    events = {
        kind: {
            "stored": int(numbers[f"{kind}_stored"]),
            "decoded": int(numbers[f"{kind}_made"]),
            "gained": int(numbers[f"{kind}_made"] - numbers[f"{kind}_both"]),
            "lost": int(numbers[f"{kind}_stored"] - numbers[f"{kind}_both"]),
        }
        for kind in _KINDS
    }
    compared = int(numbers["compared"])
    return {
        "contacts_stored": int(numbers["contacts_stored"]),
        "contacts_decoded": int(numbers["contacts_made"]),
        "compared": compared,
        "force_difference_newton_rms": (numbers["square_newton2"] / compared) ** 0.5 if compared else None,
        "events": events,
    }


def _vector(force_newton: Any) -> Floats:
    """Return a force as an array of three; a component that is not known or measured counts as 0."""
    return np.nan_to_num(np.array([np.nan if part is None else part for part in force_newton], np.float64))


def _matches(stored: list[Event], made: list[Event]) -> Counter[str]:
    """Count the events of both that are the same, each used once, in the order of time."""
    both: Counter[str] = Counter()
    left = sorted(made, key=lambda event: event[2])
    for kind, site, t_ns in sorted(stored, key=lambda event: event[2]):
        for index, (other_kind, other_site, other_ns) in enumerate(left):
            if (other_kind, other_site) == (kind, site) and abs(other_ns - t_ns) <= SAME_EVENT_NS:
                del left[index]
                both[kind] += 1
                break
            if other_ns > t_ns + SAME_EVENT_NS:
                break
    return both
