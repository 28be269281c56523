"""Decoding of a skin: frames are offered, their messages are delivered at once or later."""

import logging
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any, Final, Generic, Literal, Protocol, TypeVar

from resonator_daemon.base.reasons import Reason, ReasonCode, joined
from resonator_daemon.measure.sensors.surface_requests import (
    EndContacts,
    Reply,
    Request,
    Results,
    SetUpStep,
    SurfaceFrame,
    SurfaceSettings,
    Undecodable,
    Work,
)
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.payloads import ContactEvent, Contacts, EventContact, Lost, Message, Status
from resonator_daemon.mqtt.topics import CONTACTS, DECODED, TOPICS, HeaderFields, Topic

WAIT_MAX_NS: Final = 30_000_000  # of a frame while newer ones are there
AGE_MAX_NS: Final = 100_000_000  # of a frame that is decoded, since it was offered
ERRORS_OF_RESULTS: Final = (ReasonCode.SENSOR_SUSPECT, ReasonCode.FIT_CONTRADICTED)  # while frames are decoded
_FITS_S: Final = 0.2  # for which a contact lasts whose fit shows that the model holds again

Skipped = Literal["newer_frame", "too_old", "measured_late", "no_noise", "not_ready", "decoder_ended", "undecodable"]
Origin = TypeVar("Origin")
TakenOrigin = TypeVar("TakenOrigin", contravariant=True)

log = logging.getLogger(__name__)


class SurfaceClient(Protocol[TakenOrigin]):
    """Receiver of the messages; each frame is offered with an origin, which is given back with its messages."""

    def deliver(self, origin: TakenOrigin, topic: Topic[Any], message: Message | Encoded) -> None:
        """Publish a message of a stream."""

    def deliver_event(self, origin: TakenOrigin, event: ContactEvent) -> None:
        """Publish an event under the next number of its topic."""

    def announce(self, note: Reason | None) -> None:
        """Report what is being set up, why nothing is decoded, or `ERRORS_OF_RESULTS`; None while all is well."""

    def contacts_header(self, origin: TakenOrigin) -> HeaderFields:
        """Return the header of one more message on `contacts`."""

    def lost(self, origin: TakenOrigin) -> Lost:
        """Return the losses for the header of a frame whose decoding begins now."""


class SurfaceDecoding(ABC, Generic[Origin]):
    """Decoding of the frames of one skin by a `SurfaceWorker`; to be used from one thread only.

    At most one frame is with the worker; the next ones wait in order. A frame that has waited for more than 30 ms is
    skipped if there is a newer one. Until the worker is ready this is no loss by overload, and has another cause.
    At any instant, frames measured without fault = `decoded` + sum of `skipped` + `waiting`.

    Parameters
    ----------
    settings
    client
        Receives the messages.
    name
        Name of the plate, for the log.

    Attributes
    ----------
    decoded
        Number of frames whose map was delivered.
    skipped
        Number of frames that were not decoded, by cause.
    last_contact_id
        The highest number of a contact so far.
    suspects
        Identifiers of the suspect sites.
    """

    def __init__(self, settings: SurfaceSettings, client: SurfaceClient[Origin], name: str = "skin") -> None:
        self._settings = settings
        self._client = client
        self._name = name
        self._waiting: deque[tuple[Origin, SurfaceFrame, int]] = deque()  # with the time of its offer
        self._present: Origin | None = None  # of the frame that the worker has, until its map is there
        self._present_offered_ns = 0
        self._last: Origin | None = None  # of the frame that the worker received last
        self._contacts: tuple[EventContact, ...] = ()  # between onset and release
        self._ready_ns: int | None = None  # since when the worker decodes
        self._until_ready: Skipped = "not_ready"  # cause of frames that were offered before
        self._interruption: Reason | None = None
        self._undecodable = False
        self._is_contradicted = False
        self.suspects: tuple[int, ...] = ()
        self._announced_reason: Reason | None = None  # of errors
        self.decoded = 0
        self.skipped: Counter[Skipped] = Counter()
        self.last_contact_id = settings.last_contact_id

    @abstractmethod
    def _wake(self) -> None:
        """Have the worker serve `_next_request` as soon as it can."""

    @abstractmethod
    async def run(self) -> None:
        """Decode until cancelled, or until it turns out that the sites cannot be decoded."""

    @property
    def waiting(self) -> int:
        """Number of frames that are being decoded, or wait."""
        return (self._present is not None) + len(self._waiting)

    @property
    def frames_late(self) -> int:
        """Number of frames that were not decoded in time, because of the time that decoding takes."""
        return self.skipped["newer_frame"] + self.skipped["too_old"] + self.skipped["decoder_ended"]

    def offer(self, origin: Origin, frame: SurfaceFrame) -> None:
        """Queue a frame for decoding; it is skipped when it waits for too long. Never waits."""
        if self._undecodable:
            self.skipped["undecodable"] += 1
            return
        self._waiting.append((origin, frame, time.monotonic_ns()))
        self._skip_old()
        self._wake()

    def skip_late(self) -> None:
        """Count a frame that is not offered because it was measured too late."""
        self.skipped["measured_late"] += 1

    def interrupt(self, reason: Reason) -> None:
        """Release all contacts, because frames have stopped arriving; never waits."""
        self._interruption = reason
        self._is_contradicted = False
        self._wake()

    def release_contacts(self, reason: Reason) -> None:
        """Release the contacts of a worker that has ended, as they were published last; its checks are discarded."""
        self.suspects, self._is_contradicted, self._announced_reason = (), False, None
        if not self._contacts or self._last is None:
            return
        ended, self._contacts = self._contacts, ()
        header, decoder_id = self._client.contacts_header(self._last), self._settings.decoder_id
        because = {"reason_code": reason.code, "decoder_id": decoder_id}
        for contact in ended:
            event = ContactEvent(**header, event="release", reason=reason.text, contact=contact, **because)
            self._client.deliver_event(self._last, event)
        self._client.deliver(self._last, CONTACTS, Contacts(**header, status=Status.NO_SIGNAL, contacts=(), **because))

    def _next_request(self) -> Request | None:
        """Return what the worker is to do next; None if nothing waits."""
        if self._interruption is not None:
            reason, self._interruption = self._interruption, None
            header = self._client.contacts_header(self._last) if self._contacts and self._last is not None else None
            return EndContacts(header, reason)
        if not self._waiting:
            return None
        self._skip_old()
        origin, frame, self._present_offered_ns = self._waiting.popleft()
        self._present = self._last = origin
        frame.header["lost"] = self._client.lost(origin)  # with the frames skipped since it was offered
        return Work(frame, self._present_offered_ns + AGE_MAX_NS, is_last=not self._waiting)

    def _skip_old(self) -> None:
        """Skip frames that have waited for too long, but for the newest."""
        oldest_ns = time.monotonic_ns() - WAIT_MAX_NS
        while len(self._waiting) > 1 and self._waiting[0][2] < oldest_ns:
            self._skip(self._waiting.popleft()[2], "newer_frame")

    def _skip(self, offered_ns: int, cause: Skipped) -> None:
        """Count a frame that the worker was too slow for, unless it came before the worker was ready."""
        in_time = self._ready_ns is not None and offered_ns > self._ready_ns
        self.skipped[cause if in_time else self._until_ready] += 1

    def _skip_present(self, cause: Skipped) -> None:
        if self._present is not None:
            self.skipped[cause] += 1
            self._present = None

    def _skip_all(self) -> None:
        """Count the frames that no worker will decode."""
        cause: Skipped = "undecodable" if self._undecodable else "decoder_ended"
        self._skip_present(cause)
        while self._waiting:
            self._waiting.pop()
            self.skipped[cause] += 1

    def _received(self, reply: Reply) -> None:
        match reply:
            case Results():
                self._deliver(reply)
            case SetUpStep():
                self._set_up(reply.step)
            case Undecodable():
                self._undecodable = True
                self._skip_present("undecodable")
                log.error("%s: nothing is decoded: %s", self._name, reply.reason)
                self._client.announce(Reason(ReasonCode.UNDECODABLE, f"nothing is decoded: {reply.reason}"))

    def _set_up(self, step: str) -> None:
        log.info("decoder of %s %s", self._name, f"is being set up: {step}" if step else "is ready")
        if not step:
            self._ready_ns = time.monotonic_ns()
            self._client.announce(self._announced_reason)
            return
        if self._ready_ns is not None:  # set up again while it runs
            self._ready_ns, self._until_ready = None, "not_ready"
        self._client.announce(Reason(ReasonCode.DECODER_STARTING, f"decoder is being set up: {step}"))

    def _deliver(self, results: Results) -> None:
        origin = self._last
        for path, message in results.messages:
            if origin is None:
                raise ValueError("results of no frame")
            if isinstance(message, ContactEvent):
                self.last_contact_id = max(self.last_contact_id, message.contact.id)
                self._client.deliver_event(origin, message)
                continue
            topic = TOPICS[path]
            if topic is DECODED:
                self.decoded += 1
                self._present = None
            self._client.deliver(origin, topic, message)
        if results.present is not None:
            self._contacts = results.present
            self.suspects = self.suspects if results.suspects is None else results.suspects
            self._announce_errors(results.present)
        if results.outcome == "no_noise":
            self._skip_present("no_noise")
        elif results.outcome == "too_old":
            self._skip(self._present_offered_ns, "too_old")
            self._present = None

    def _announce_errors(self, contacts: Sequence[EventContact]) -> None:
        """Announce suspect sites and contradicted fits, if they have changed.

        A contradiction is withdrawn when a contact has lasted for `_FITS_S` without one.
        """
        contradicted = any(contact.reason_code is ReasonCode.FIT_CONTRADICTED for contact in contacts)
        if contradicted or any(contact.duration_s > _FITS_S for contact in contacts):
            self._is_contradicted = contradicted
        text = "the signals contradict the model of a contact, so that its errors are larger than stated"
        fit = Reason(ReasonCode.FIT_CONTRADICTED, text) if self._is_contradicted else None
        sites = f"{'sites' if len(self.suspects) > 1 else 'site'} {', '.join(map(str, self.suspects))}"
        text = f"{sites}: the signals differ from what those of all other sites predict"
        reason = joined(Reason(ReasonCode.SENSOR_SUSPECT, text) if self.suspects else None, fit)
        if reason != self._announced_reason:
            self._announced_reason = reason
            self._client.announce(reason)


MakeSurfaceDecoding = Callable[[SurfaceSettings, SurfaceClient[Any]], SurfaceDecoding[Any]]
