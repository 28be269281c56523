"""Streaming decoder of one skin: sets decoders up as the noise changes, and survives frames that fail."""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.decoded import Decoded
from resonator_daemon.estimate.surface.decoder_setup import CANNOT_DECODE, set_up
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_contacts import SkinEvent
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder, SurfaceReading, rounded_noise

log = logging.getLogger(__name__)


_LOGGED_MAX = 20
_logged: set[str] = set()  # failures that were logged


class UndecodableError(ValueError):
    """The sites of a skin cannot be decoded with these options."""


class StreamingDecoder:
    """Decoder of the frames of one skin in the order of time; set up when the noise is given or has changed.

    Parameters
    ----------
    skin
        Sites and half-space.
    options
        Options of the decoder.
    progress
        Called with each step of a set-up, and with "" at its end.
    last_contact_id
        Number of the last contact of an earlier decoder; numbers go on from there.
    """

    def __init__(
        self, skin: Skin, options: DecodingOptions, progress: Callable[[str], None], last_contact_id: int = 0
    ) -> None:
        self._skin = skin
        self._options = options
        self._progress = progress
        self._last_contact_id = last_contact_id
        self._decoder: SkinDecoder | None = None
        self._map: Decoded | SurfaceReading | None = None
        self._ended: tuple[SkinEvent, ...] = ()  # contacts of a decoder that was replaced

    def prepare(self, noise_std: Floats) -> bool:
        """Set up a decoder for noise (3, n) if the present one does not fit; return whether there is one.

        Raises
        ------
        UndecodableError
            The sites cannot be decoded.
        """
        before = self._decoder
        if before is not None and before.fits(noise_std):
            return True
        built_for = rounded_noise(self._skin, noise_std)
        if built_for is None:
            return False
        self._progress("looking in the cache")
        try:
            decoder = set_up(self._skin, self._options, built_for, self._progress)
        except CANNOT_DECODE as error:
            raise UndecodableError(str(error) or repr(error)) from error
        if before is not None:
            self._ended += decoder.succeed(before)
        elif self._last_contact_id:
            decoder.number_from(self._last_contact_id)
        self._decoder = decoder
        self._progress("")
        return True

    def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
        """Return the map of a frame of signals (3, n); call `prepare` before and `read_contacts` after."""
        decoder = self._present
        try:
            self._map = decoder.decode_map(signals, noise_std)
        except Exception as error:  # noqa: BLE001  the next frame is decoded all the same
            self._map = failed(decoder, error)
        return self._map.decoded if isinstance(self._map, SurfaceReading) else self._map

    def read_contacts(self) -> SurfaceReading:
        """Return map, contacts and events of the frame that `decode_map` decoded last."""
        decoder, surface = self._present, self._map
        if surface is None:
            raise ValueError("no map was decoded")
        if isinstance(surface, Decoded):
            try:
                surface = decoder.read_contacts(surface)
            except Exception as error:  # noqa: BLE001  as above
                surface = failed(decoder, error)
        ended, self._ended = self._ended, ()
        return replace(surface, events=ended + surface.events)

    def end_contacts(self, reason: Reason) -> SurfaceReading | None:
        """End all contacts because frames have stopped arriving; return their releases, None if there are none."""
        if self._decoder is None:
            return None
        events = self._ended + self._decoder.reset(reason)
        self._ended = ()
        return nothing_decoded(self._decoder, "no_signal", reason, events) if events else None

    def start_cold(self) -> None:
        """Discard the frames before, unless a contact is followed."""
        if self._decoder is not None:
            self._decoder.start_cold()

    def check(self, pause: Callable[[], None]) -> None:
        """Check sites and contact of the frame that was decoded last, as `SkinDecoder.check`; `pause` as `rebuild`."""
        try:
            self._present.check(pause)
        except Exception:  # the next check is made all the same
            log.exception("sites and contact could not be checked")

    @property
    def suspects(self) -> tuple[int, ...]:
        """Indices of the suspect sites."""
        return self._present.suspects

    def rebuild(self, pause: Callable[[], None]) -> bool:
        """Update matrices if a contact has moved, and return whether; with `DecodingOptions.background`, call it.

        `pause` is called between parts of the update; frames may be decoded there.
        """
        try:
            return self._present.rebuild(pause)
        except Exception:  # until one succeeds, the decoder shows its map without contact physics
            log.exception("contact physics could not follow a contact")
            return True

    @property
    def _present(self) -> SkinDecoder:
        if self._decoder is None:
            raise ValueError("no decoder is set up")
        return self._decoder


def failed(decoder: SkinDecoder, error: Exception) -> SurfaceReading:
    """Return the reading of a frame whose decoding failed: all contacts end."""
    if repr(error) not in _logged and len(_logged) < _LOGGED_MAX:  # the frames that follow may fail in the same way
        _logged.add(repr(error))
        log.error("frames cannot be decoded", exc_info=error)
    reason = Reason(ReasonCode.DECODING_FAILED, f"decoder failed: {error!r}")
    return nothing_decoded(decoder, "rejected", reason, decoder.reset(reason))


def nothing_decoded(decoder: SkinDecoder, status: str, reason: Reason, events: tuple[SkinEvent, ...]) -> SurfaceReading:
    """Return a reading without a surface, with the events that end its contacts."""
    decoded = Decoded.unknown((3, *decoder.shape), True, np.nan, np.nan, status, reason)
    return SurfaceReading(decoder.name, decoded, events=events)
