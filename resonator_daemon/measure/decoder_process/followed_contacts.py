"""Contacts of a decoder process, as its messages show them, so that the daemon can release them when it ends."""

from collections.abc import Iterator
from typing import Final

from resonator_daemon.base.reasons import Reason
from resonator_daemon.mqtt.codec import decode
from resonator_daemon.mqtt.headers import MeasuredFields
from resonator_daemon.mqtt.payloads import ContactEvent, Contacts, EventContact, Status

_NS: Final = 1_000_000_000


class FollowedContacts:
    """Contacts between their onset and their release.

    Attributes
    ----------
    last_id
        The highest number so far.
    """

    def __init__(self, last_id: int = 0) -> None:
        self._present: dict[int, tuple[EventContact, str | None]] = {}  # last state and decoder, by contact
        self.last_id = last_id

    def __bool__(self) -> bool:
        return bool(self._present)

    def add_event(self, event: ContactEvent) -> None:
        """Add the contact of an onset, remove that of a release."""
        contact = event.contact.id
        self.last_id = max(self.last_id, contact)
        if event.event == "release":
            self._present.pop(contact, None)
        else:
            self._present[contact] = event.contact, event.decoder_id

    def add_contacts(self, payload: bytes) -> None:
        """Update the present contacts by a message of `contacts`."""
        if not self._present:
            return
        message = decode(Contacts, payload)
        for contact in message.contacts:
            if contact.id in self._present:
                before, decoder_id = self._present[contact.id]
                history = {
                    "peak_newton": max(before.peak_newton, contact.force_newton[2]),
                    "since_t_ns": before.since_t_ns,
                    "duration_s": (message.t_ns - before.since_t_ns) / _NS,
                }
                self._present[contact.id] = EventContact(**dict(contact), **history), decoder_id

    def release(self, header: MeasuredFields, reason: Reason) -> Iterator[ContactEvent]:
        """Yield the release of each contact with its last state, and remove them all; `seq` is that of the header."""
        ended, self._present = self._present, {}
        for contact, decoder_id in ended.values():
            yield ContactEvent(
                **header,
                event="release",
                reason_code=reason.code,
                reason=reason.text,
                contact=contact,
                decoder_id=decoder_id,
            )


def no_contacts(header: MeasuredFields, reason: Reason, decoder_id: str | None) -> Contacts:
    """Return the message on `contacts` after all of them have ended."""
    return Contacts(**header, status=Status.NO_SIGNAL, reason_code=reason.code, contacts=(), decoder_id=decoder_id)
