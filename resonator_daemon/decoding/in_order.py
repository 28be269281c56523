"""Decoding of each frame in its turn, however long it takes: the same signals give the same results every time."""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.skin import Skin, Wanted
from resonator_daemon.decoding.skin_contacts import SkinEvent
from resonator_daemon.decoding.skin_decoder import SkinDecoder, SurfaceReading, rounded_noise
from resonator_daemon.decoding.stage import CANNOT_DECODE, decode_map, nothing_decoded, read_contacts, set_up

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Origin = TypeVar("Origin")


class DecodingInOrder(Generic[Origin]):
    """Does what `DecodingStage` does, within `offer` and `interrupt`; takes the same arguments.

    Contact physics prepares its matrices while it decodes. What is being set up is not announced: that depends on what
    is cached.

    Attributes
    ----------
    frames_skipped
        Nothing told the noise yet, or the sites cannot be decoded.
    """

    def __init__(
        self,
        skin: Skin,
        wanted: Wanted,
        deliver_map: Callable[[Origin, Decoded], None],
        deliver: Callable[[Origin, SurfaceReading], None],
        announce: Callable[[str], None],
    ) -> None:
        self._skin = skin
        self._wanted = replace(wanted, background=False)
        self._deliver_map = deliver_map
        self._deliver = deliver
        self._announce = announce
        self._decoder: SkinDecoder | None = None
        self._last_origin: Origin | None = None
        self._ended: tuple[SkinEvent, ...] = ()  # contacts of a decoder that was replaced
        self._impossible = False
        self.frames_skipped = 0

    async def run(self) -> None:
        """Return at once: all is done when it is offered."""

    def offer(self, origin: Origin, signals: Floats, noise_std: Floats) -> None:
        """Decode one frame, both arrays (3, sites), the dimensionless triple, and deliver it."""
        decoder = self._decoder_for(noise_std)
        if decoder is None:
            self.frames_skipped += 1
            return
        surface = decode_map(decoder, signals, noise_std)
        self._last_origin = origin
        self._deliver_map(origin, surface.decoded if isinstance(surface, SurfaceReading) else surface)
        if isinstance(surface, Decoded):
            surface = read_contacts(decoder, surface)
        ended, self._ended = self._ended, ()
        self._deliver(origin, replace(surface, events=ended + surface.events))

    def interrupt(self, reason: str) -> None:
        """End all contacts, because frames have stopped coming."""
        if self._decoder is None or self._last_origin is None:
            return
        if events := tuple(replace(event, reason=reason) for event in self._decoder.reset()):
            self._deliver(self._last_origin, nothing_decoded(self._decoder, "no_signal", reason, events))

    def _decoder_for(self, noise_std: Floats) -> SkinDecoder | None:
        before = self._decoder
        if self._impossible or (before is not None and before.fits(noise_std)):
            return before
        if (built_for := rounded_noise(self._skin, noise_std)) is None:
            return None
        try:
            decoder = set_up(self._skin, self._wanted, built_for, lambda step: log.info("setting up: %s", step))
        except CANNOT_DECODE as error:
            self._impossible, self._decoder = True, None
            self._announce(f"nothing is decoded: {error}")
            return None
        if before is not None:
            self._ended += decoder.succeed(before)
        self._decoder = decoder
        return decoder
