"""Frames of a skin to messages about its surface, in whichever process it is decoded."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.streaming import SetUp, StreamingDecoder
from resonator_daemon.measure.sensors.surface_messages import SurfaceMessages
from resonator_daemon.mqtt.headers import MeasuredFields
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import CONTACT_EVENT, CONTACTS, DECODED, DECODED_SUMMARY, Topic

Publish = Callable[[Topic[Any], Message], None]


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
    """

    skin: Skin
    options: DecodingOptions
    site_ids: NDArray[np.integer]
    pitch_m: float | None
    decoder_id: str | None = None
    uncertainty: bool = True
    last_contact_id: int = 0


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

    header: MeasuredFields
    contacts_seq: int
    signals: Floats
    noise_std: Floats
    at_rest: bool = False


class SurfaceStream:
    """Streaming decoder with the messages about its frames.

    The publisher numbers the events: their `seq` here is that of the frame.

    Parameters
    ----------
    settings
    publish
        Called with topic and message: the map first, then the events, the summary and the contacts.
    progress
        Called with each step of a set-up, and with "" at its end.
    build
        As of `StreamingDecoder`.
    """

    def __init__(
        self,
        settings: SurfaceSettings,
        publish: Publish,
        progress: Callable[[str], None],
        build: SetUp | None = None,
    ) -> None:
        self._decoder = StreamingDecoder(settings.skin, settings.options, progress, settings.last_contact_id, build)
        self._reporter = SurfaceMessages(
            settings.site_ids,
            settings.skin.site_positions_m,
            settings.pitch_m,
            settings.decoder_id,
            uncertainty=settings.uncertainty,
        )
        self._publish = publish

    def prepare(self, frame: SurfaceFrame) -> bool:
        """Set up a decoder for the noise of this frame if necessary; return whether there is one.

        Raises
        ------
        UndecodableError
            The sites cannot be decoded.
        """
        return self._decoder.prepare(frame.noise_std)

    def decode(self, frame: SurfaceFrame) -> None:
        """Decode a frame that `prepare` has accepted."""
        header = frame.header
        decoded = self._decoder.decode_map(frame.signals, frame.noise_std)
        self._publish(DECODED, self._reporter.decoded(header, decoded))
        surface = self._decoder.read_contacts()
        for event in surface.events:
            self._publish(CONTACT_EVENT, self._reporter.event(header, event))
        self._publish(DECODED_SUMMARY, self._reporter.summary(header, surface))
        self._publish(CONTACTS, self._reporter.contacts(_numbered(header, frame.contacts_seq), surface))

    def start_cold(self) -> None:
        """Discard the frames before, unless a contact is followed."""
        self._decoder.start_cold()

    def end_contacts(self, header: Callable[[], MeasuredFields], reason: Reason) -> None:
        """Release all contacts for a reason; `header` returns that of the message on `contacts`, if there is one."""
        surface = self._decoder.end_contacts(reason)
        if surface is not None:
            fields = header()
            for event in surface.events:
                self._publish(CONTACT_EVENT, self._reporter.event(fields, event))
            self._publish(CONTACTS, self._reporter.contacts(fields, surface))

    def rebuild(self) -> bool:
        """Update matrices if a contact has moved, and return whether; with `DecodingOptions.background`, call it."""
        return self._decoder.rebuild()


def _numbered(header: MeasuredFields, seq: int) -> MeasuredFields:
    own = header.copy()
    own["seq"] = seq
    return own
