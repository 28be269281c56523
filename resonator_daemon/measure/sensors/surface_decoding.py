"""Interface of the decoding of a skin: frames are offered, their messages are delivered at once or later."""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Generic, Protocol, TypeVar

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.streaming import UndecodableError
from resonator_daemon.measure.sensors.surface_stream import SurfaceFrame, SurfaceSettings, SurfaceStream
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.headers import MeasuredFields
from resonator_daemon.mqtt.payloads import ContactEvent, Lost, Message
from resonator_daemon.mqtt.topics import Topic

log = logging.getLogger(__name__)

Origin = TypeVar("Origin")
TakenOrigin = TypeVar("TakenOrigin", contravariant=True)


class SurfaceClient(Protocol[TakenOrigin]):
    """Receiver of the messages; each frame is offered with an origin, which is given back with its messages."""

    def deliver(self, origin: TakenOrigin, topic: Topic[Any], message: Message | Encoded) -> None:
        """Publish a message of a stream."""

    def deliver_event(self, origin: TakenOrigin, event: ContactEvent) -> None:
        """Publish an event under the next number of its topic."""

    def announce(self, note: Reason | None) -> None:
        """Report what is being set up, or why nothing is decoded; "" while frames are decoded."""

    def contacts_header(self, origin: TakenOrigin) -> MeasuredFields:
        """Return the header of one more message on `contacts`."""

    def lost(self, origin: TakenOrigin) -> Lost:
        """Return the losses for the header of a frame whose decoding begins now."""


class SurfaceDecoding(Protocol[TakenOrigin]):
    """Decoding of the frames of one skin."""

    @property
    def frames_skipped(self) -> int:
        """Number of frames that will never be decoded."""

    @property
    def frames_late(self) -> int:
        """Number of those that were not decoded in time, because of the time that decoding takes."""

    def offer(self, origin: TakenOrigin, frame: SurfaceFrame) -> None:
        """Decode a frame, or skip it; never waits."""

    def skip_late(self) -> None:
        """Count a frame that is not offered because it was measured too late."""

    def interrupt(self, reason: Reason) -> None:
        """Release all contacts, because frames have stopped arriving; never waits. After `run`: at once."""

    async def run(self) -> None:
        """Decode until cancelled, or until it turns out that the sites cannot be decoded."""


class SequentialDecoding(Generic[Origin]):
    """Decoding of each frame within `offer`: the same frames give the same messages every time.

    Contact physics prepares its matrices while it decodes. Steps of the set-up are not announced: they depend on the
    cache.

    Parameters
    ----------
    settings
    client
    cold_at_rest
        Whether the decoder starts cold at each frame at rest. What follows then does not depend on what was before.

    Attributes
    ----------
    frames_skipped
        Number of frames that came before the noise of each channel was measured, or whose sites cannot be decoded.
    frames_late
        Always 0.
    """

    def __init__(self, settings: SurfaceSettings, client: SurfaceClient[Origin], *, cold_at_rest: bool = False) -> None:
        options = replace(settings.options, background=False)
        self._stream = SurfaceStream(replace(settings, options=options), self._publish, _log_step)
        self._client = client
        self._cold_at_rest = cold_at_rest
        self._origin: Origin | None = None
        self._undecodable = False
        self.frames_skipped = 0
        self.frames_late = 0

    async def run(self) -> None:
        """Return at once: all is done when it is offered."""

    def offer(self, origin: Origin, frame: SurfaceFrame) -> None:
        """Decode a frame."""
        try:
            ready = not self._undecodable and self._stream.prepare(frame)
        except UndecodableError as error:
            self._undecodable, ready = True, False
            self._client.announce(Reason(ReasonCode.UNDECODABLE, f"nothing is decoded: {error}"))
        if not ready:
            self.frames_skipped += 1
            return
        self._origin = origin
        if self._cold_at_rest and frame.at_rest:
            self._stream.start_cold()
        self._stream.decode(frame)

    def skip_late(self) -> None:
        """Count a frame that is not offered because it was measured too late."""
        self.frames_skipped += 1

    def interrupt(self, reason: Reason) -> None:
        """Release all contacts, because frames have stopped arriving."""
        origin = self._origin
        if origin is not None and not self._undecodable:
            self._stream.end_contacts(lambda: self._client.contacts_header(origin), reason)

    def _publish(self, topic: Topic[Any], message: Message) -> None:
        if self._origin is None:
            raise ValueError("no frame was decoded")
        if isinstance(message, ContactEvent):
            self._client.deliver_event(self._origin, message)
        else:
            self._client.deliver(self._origin, topic, message)


def _log_step(step: str) -> None:
    if step:
        log.info("decoder is being set up: %s", step)


MakeSurfaceDecoding = Callable[[SurfaceSettings, SurfaceClient[Any]], SurfaceDecoding[Any]]
