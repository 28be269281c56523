"""Contacts of a decoder process, as its messages show them, so that the daemon can release them when it ends."""

from collections.abc import Iterator

from resonator_daemon.publishing.codec import decode
from resonator_daemon.publishing.headers import MeasuredFields
from resonator_daemon.publishing.payloads import ContactEvent, Contacts, EventContact, Status


class FollowedContacts:
    """Contacts between their onset and their release.

    Attributes
    ----------
    last_id
        The highest number so far.
    """

    def __init__(self, last_id: int = 0) -> None:
        self._last_event: dict[int, ContactEvent] = {}  # by contact
        self._last_contacts = b""  # payload
        self.last_id = last_id

    def __bool__(self) -> bool:
        return bool(self._last_event)

    def add_event(self, event: ContactEvent) -> None:
        """Add the contact of an onset, remove that of a release."""
        contact = event.contact.id
        self.last_id = max(self.last_id, contact)
        if event.event == "release":
            self._last_event.pop(contact, None)
        else:
            self._last_event[contact] = event

    def add_contacts(self, payload: bytes) -> None:
        """Store the last message of `contacts`: it has the present state of most contacts."""
        self._last_contacts = payload

    def release(self, header: MeasuredFields, reason: str) -> Iterator[ContactEvent]:
        """Yield the release of each contact with its last state, and remove them all; `seq` is that of the header."""
        last = decode(Contacts, self._last_contacts).contacts if self._last_contacts else ()
        latest = {contact.id: contact.model_dump() for contact in last}
        ended, self._last_event, self._last_contacts = self._last_event, {}, b""
        for contact, event in ended.items():
            state = EventContact(**(event.contact.model_dump() | latest.get(contact, {})))
            yield ContactEvent(**header, event="release", reason=reason, contact=state, decoder_id=event.decoder_id)


def no_contacts(header: MeasuredFields, reason: str, decoder_id: str | None) -> Contacts:
    """Return the message on `contacts` after all of them have ended."""
    return Contacts(**header, status=Status.NO_SIGNAL, reason=reason, contacts=(), decoder_id=decoder_id)
