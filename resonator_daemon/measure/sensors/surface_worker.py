"""Frames of a skin to messages about its surface: requests in, replies out, in whichever process or thread it runs."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from resonator_daemon.estimate.surface.streaming import StreamingDecoder, UndecodableError
from resonator_daemon.measure.sensors.surface_decoding import Origin, SurfaceClient, SurfaceDecoding
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
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import CONTACT_EVENT, CONTACTS, DECODED, DECODED_SUMMARY

_REBUILD_FRAMES: Final = 3  # between two rebuilds, at least: they take as long as some frames
_CHECK_NS: Final = 500_000_000  # between two checks of sites and contact while something presses them
_NO_LIMIT_NS: Final = 1 << 62

log = logging.getLogger(__name__)


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
        self, settings: SurfaceSettings, send: Callable[[Reply], None], serve_waiting: Callable[[], None] = lambda: None
    ) -> None:
        self._settings = settings
        self._send = send
        self._decoder = StreamingDecoder(
            settings.skin, settings.options, lambda step: send(SetUpStep(step)), settings.last_contact_id
        )
        self._reporter = settings.messages()
        self._checked_ns = 0  # time of the frame that was checked last; 0 without a contact
        self.is_behind = self._check_is_due = self._is_updating = False
        self._frames = 0  # since the last rebuild
        self._serve_waiting = serve_waiting

    def serve(self, request: Request) -> None:
        """Serve a request; then, unless it came during an update, check the model and follow contacts that moved."""
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
            self._decoder.check(self._serve_waiting)
        is_due = self._settings.options.background and self._frames >= _REBUILD_FRAMES
        if is_due and self._decoder.rebuild(self._serve_waiting):
            self._frames = 0


class SequentialDecoding(SurfaceDecoding[Origin]):
    """Decoding of each frame within `offer`: the same frames give the same messages every time.

    Contact physics prepares its matrices while it decodes. Steps of the set-up are not announced: they depend on the
    cache.
    """

    def __init__(self, settings: SurfaceSettings, client: SurfaceClient[Origin], name: str = "skin") -> None:
        super().__init__(settings, client, name)
        options = replace(settings.options, background=False)
        self._worker = SurfaceWorker(replace(settings, options=options), self._received)

    async def run(self) -> None:
        """Return at once: all is done when it is offered."""

    def _wake(self) -> None:
        request = self._next_request()
        if isinstance(request, Work):
            request = Work(request.frame, _NO_LIMIT_NS)
        if request is not None:
            self._worker.serve(request)

    def _set_up(self, step: str) -> None:
        if step:
            log.info("decoder is being set up: %s", step)
