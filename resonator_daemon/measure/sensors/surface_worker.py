"""Frames of a skin to messages about its surface: requests in, replies out, in whichever process or thread it runs."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate_tables import Skin as PlateSkin
from resonator_daemon.base.reasons import Reason
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.skin import DecodingOptions, Prior, Skin
from resonator_daemon.estimate.surface.streaming import StreamingDecoder, UndecodableError
from resonator_daemon.measure.sensors.surface_messages import SurfaceMessages
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.payloads import EventContact, Message, SkinInfo
from resonator_daemon.mqtt.topics import CONTACT_EVENT, CONTACTS, DECODED, DECODED_SUMMARY, HeaderFields

_REBUILD_FRAMES: Final = 3  # between two rebuilds, at least: they take as long as some frames
_CHECK_NS: Final = 500_000_000  # between two checks of the sites while something presses them

Outcome = Literal["ready", "decoded", "too_old", "no_noise"]


@dataclass(frozen=True)
class SurfaceSettings:
    """Settings from which the messages about one skin follow.

    Attributes
    ----------
    skin, options
    site_ids
        Shape (n,).
    pitch_m
        Pitch of the grid that the sites form; None if they are scattered.
    decoder_id
        Key of the messages; None for a daemon.
    uncertainty
        Whether `decoded` has the traction's standard deviation.
    last_contact_id
        Number of the last contact so far; numbers go on from there.
    cold_at_rest
        Whether the decoder starts cold at each frame at rest. What follows then does not depend on what was before.
    numbered
        As of `SurfaceMessages`.
    """

    skin: Skin
    options: DecodingOptions
    site_ids: NDArray[np.integer]
    pitch_m: float | None
    decoder_id: str | None = None
    uncertainty: bool = True
    last_contact_id: int = 0
    cold_at_rest: bool = False
    numbered: bool = True

    def messages(self) -> SurfaceMessages:
        """Return the maker of this skin's messages."""
        return SurfaceMessages(
            self.site_ids,
            self.skin.site_positions_m,
            self.pitch_m,
            self.decoder_id,
            uncertainty=self.uncertainty,
            numbered=self.numbered,
        )


def stated_skin(stated: PlateSkin | SkinInfo, site_positions_m: Floats) -> Skin:
    """Return the skin that a plate file or `info` states; ValueError if it cannot be one."""
    return Skin(
        HalfSpace(stated.youngs_modulus_pascal, stated.poisson_ratio),
        site_positions_m,
        stated.depth_m,
        stated.gain_std,
        Prior(stated.correlation_length_m, stated.tangential_ratio),
        depth_std_m=stated.depth_std_m,
        modulus_std_pascal=stated.modulus_std_pascal,
        gain_std_common=stated.gain_std_common,
        position_std_m=stated.position_std_m,
    )


@dataclass(frozen=True)
class SurfaceFrame:
    """One frame to be decoded.

    Attributes
    ----------
    header
        Header of `decoded` and `decoded/summary`.
    contacts_seq
        Number `seq` of `contacts`.
    signals, noise_std
        Shape (3, n), dimensionless.
    at_rest
        Whether nothing has touched the skin for a while, as of a `SkinReading`.
    """

    header: HeaderFields
    contacts_seq: int
    signals: Floats
    noise_std: Floats
    at_rest: bool = False


@dataclass(frozen=True)
class Work:
    """Request to decode a frame, unless its time, by CLOCK_MONOTONIC, is over; `is_last`: no other frame waits."""

    frame: SurfaceFrame
    until_ns: int
    is_last: bool = True


@dataclass(frozen=True)
class EndContacts:
    """Request to release all contacts; `header` is that of the message on `contacts`, None if there are no contacts."""

    header: HeaderFields | None
    reason: Reason


@dataclass(frozen=True)
class Results:
    """Messages that follow from a request, by the path of their topic; the last reply to a request has its outcome.

    Attributes
    ----------
    messages
        The publisher numbers the events: their `seq` here is that of the frame.
    outcome
    present
        The contacts between onset and release after these messages; None if they are the same as before.
    suspects
        Identifiers of the suspect sites; None if they are the same as before.
    """

    messages: tuple[tuple[str, Message | Encoded], ...]
    outcome: Outcome | None
    present: tuple[EventContact, ...] | None = None
    suspects: tuple[int, ...] | None = None


@dataclass(frozen=True)
class SetUpStep:
    """A step of a set-up begins; "" when the set-up is done."""

    step: str


@dataclass(frozen=True)
class Undecodable:
    """The sites cannot be decoded, for the given reason; nothing more is served."""

    reason: str


Request = Work | EndContacts
Reply = Results | SetUpStep | Undecodable


class SurfaceWorker:
    """Streaming decoder of one skin that serves one request after the other.

    Parameters
    ----------
    settings
    send
        Called with each reply. The map of a frame is sent before its contacts are evaluated.
    serve_waiting
        Called between parts of an update that follows a frame: serves requests that wait.

    Attributes
    ----------
    is_behind
        Whether another frame waited when the last one was sent.
    """

    def __init__(
        self,
        settings: SurfaceSettings,
        send: Callable[[Reply], None],
        serve_waiting: Callable[[], None] = lambda: None,
    ) -> None:
        self._settings = settings
        self._send = send
        self._decoder = StreamingDecoder(
            settings.skin, settings.options, lambda step: send(SetUpStep(step)), settings.last_contact_id
        )
        self._reporter = settings.messages()
        self._checked_ns = 0  # time of the frame by which sites were checked last; 0 without a contact
        self.is_behind = self._check_is_due = self._is_updating = False
        self._frames = 0  # since the last rebuild
        self._serve_waiting = serve_waiting

    def serve(self, request: Request) -> None:
        """Serve a request; then, unless it came during an update, check sites and follow contacts that moved."""
        if isinstance(request, EndContacts):
            self._end_contacts(request)
            return
        self.is_behind = not request.is_last
        try:
            is_ready = self._decoder.prepare(request.frame.noise_std)
        except UndecodableError as error:
            self._send(Undecodable(str(error)))
            return
        if not is_ready:
            self._send(Results((), "no_noise"))
        elif time.monotonic_ns() > request.until_ns:
            self._send(Results((), "too_old"))
        else:
            self._decode(request.frame)
            if not self._is_updating:
                self._is_updating = True
                self._update()
                self._is_updating = False

    def _decode(self, frame: SurfaceFrame) -> None:
        if self._settings.cold_at_rest and frame.at_rest:
            self._decoder.start_cold()
        header, reporter = frame.header, self._reporter
        self._frames += 1
        decoded = self._decoder.decode_map(frame.signals, frame.noise_std)
        self._send(Results(((DECODED.path, reporter.decoded(header, decoded)),), None))
        surface = self._decoder.read_contacts()
        contacts_header = header.copy()
        contacts_header["seq"] = frame.contacts_seq
        messages = (
            *((CONTACT_EVENT.path, reporter.event(header, event)) for event in surface.events),
            (DECODED_SUMMARY.path, reporter.summary(header, surface)),
            (CONTACTS.path, reporter.contacts(contacts_header, surface)),
        )
        self._plan_check(header["t_ns"] if surface.contacts else 0)
        suspects = tuple(self._settings.site_ids[list(self._decoder.suspects)].tolist())
        self._send(Results(messages, "decoded", tuple(reporter.present.values()), suspects))

    def _end_contacts(self, request: EndContacts) -> None:
        surface, header, reporter = self._decoder.end_contacts(request.reason), request.header, self._reporter
        messages: list[tuple[str, Message]] = []
        if surface is not None:
            if header is None:
                raise ValueError("contacts ended of which no event was received")
            messages += [(CONTACT_EVENT.path, reporter.event(header, event)) for event in surface.events]
            messages.append((CONTACTS.path, reporter.contacts(header, surface)))
        self._send(Results(tuple(messages), "ready", ()))

    def _plan_check(self, t_ns: int) -> None:
        if t_ns == 0 or self._checked_ns == 0:
            self._checked_ns = t_ns
        elif abs(t_ns - self._checked_ns) >= _CHECK_NS:
            self._checked_ns = t_ns
            self._check_is_due = True

    def _update(self) -> None:
        """Do what is due, in parts between which requests are served."""
        self._serve_waiting()
        if self._check_is_due:
            self._check_is_due = False
            self._decoder.check_sites(self._serve_waiting)
        is_due = self._settings.options.background and self._frames >= _REBUILD_FRAMES
        if is_due and self._decoder.rebuild(self._serve_waiting):
            self._frames = 0
