"""Decodes frames of many skins, each on its own; of each plate the newest, plates in turn."""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from threadpoolctl import threadpool_limits

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.skin import DecodingOptions
from resonator_daemon.decoding.skin_decoder import SkinDecoder, SurfaceReading, rounded_noise
from resonator_daemon.decoding.streaming import CANNOT_DECODE, failed, set_up
from resonator_daemon.reasons import Reason, ReasonCode
from resonator_daemon.remote_decoding.plate import SkinPlate, error_text

DECODERS_MAX: Final = 4  # of some 80 MB; equal skins share one

Origin = TypeVar("Origin")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Frame(Generic[Origin]):
    origin: Origin
    skin: SkinPlate
    signals: Floats
    noise_std: Floats


class SharedStage(Generic[Origin]):
    """Decoder in a thread of its own; signals that come while it is busy replace those of their plate that wait.

    Parameters
    ----------
    options
        Without background: no decoder gets enough frames of a plate to follow it.
    deliver
        Called on the event loop with the plate, what `offer` was given as origin, and the reading.
    announce
        Called on the event loop with what is being set up, and with None when that is done.
    refuse
        Called on the event loop with a plate that cannot be decoded, and why.

    Attributes
    ----------
    skipped, unusable
        Frames by plate: a newer one came first; the noise was not known, or the plate was refused.
    served
        By plate: the skin of the last frame that a decoder was there for.
    """

    def __init__(
        self,
        options: DecodingOptions,
        deliver: Callable[[str, Origin, SurfaceReading], None],
        announce: Callable[[Reason | None], None],
        refuse: Callable[[str, Reason], None],
    ) -> None:
        self._options = options
        self._deliver = deliver
        self._announce = announce
        self._refuse = refuse
        self._newest: dict[str, _Frame[Origin]] = {}  # by plate, whose turn it is first
        self._busy_with: str | None = None
        self._offered = asyncio.Event()
        self._decoders: list[tuple[tuple[object, ...], SkinDecoder]] = []  # by geometry, the one used last at the end
        self.skipped: Counter[str] = Counter()
        self.unusable: Counter[str] = Counter()
        self.served: dict[str, SkinPlate] = {}

    def waiting(self, plate: str) -> int:
        """Frames of a plate that are being decoded, or are next."""
        return (self._busy_with == plate) + (plate in self._newest)

    def offer(self, plate: str, origin: Origin, skin: SkinPlate, signals: Floats, noise_std: Floats) -> None:
        """Queue one frame of a plate, both arrays (3, sites); never waits."""
        self.skipped[plate] += plate in self._newest
        self._newest[plate] = _Frame(origin, skin, signals, noise_std)
        self._offered.set()

    def discard(self, plate: str) -> None:
        """Discard the counters and waiting frames of a plate; the result of a frame in work is not delivered."""
        self._newest.pop(plate, None)
        self.served.pop(plate, None)
        del self.skipped[plate], self.unusable[plate]
        if self._busy_with == plate:
            self._busy_with = None

    async def run(self) -> None:
        """Decode until cancelled."""
        pool = ThreadPoolExecutor(1, thread_name_prefix="decoding")
        with threadpool_limits(1, user_api="blas"):  # as in the daemon's decoder
            try:
                while True:
                    await self._offered.wait()
                    self._offered.clear()
                    while self._newest:
                        await self._decode_next(pool)
            finally:
                self.skipped.update(self._newest.keys())
                self.skipped.update([self._busy_with] if self._busy_with is not None else [])
                self._newest, self._busy_with = {}, None
                await asyncio.to_thread(pool.shutdown)

    async def _decode_next(self, pool: ThreadPoolExecutor) -> None:
        plate = next(iter(self._newest))
        frame = self._newest.pop(plate)
        self._busy_with = plate
        decoder = await self._decoder_for(plate, frame, pool)
        if self._busy_with is None:  # the plate was removed meanwhile
            return
        if decoder is None:
            self.unusable[plate] += 1
            self._busy_with = None
            return
        self.served[plate] = frame.skin
        reading = await asyncio.get_running_loop().run_in_executor(
            pool, _decode, decoder, frame.signals, frame.noise_std
        )
        if self._busy_with is None:
            return
        self._busy_with = None
        self._deliver(plate, frame.origin, reading)

    async def _decoder_for(self, plate: str, frame: _Frame[Origin], pool: ThreadPoolExecutor) -> SkinDecoder | None:
        geometry = frame.skin.geometry
        for index, (known, decoder) in enumerate(self._decoders):
            if known == geometry and decoder.fits(frame.noise_std):
                self._decoders.append(self._decoders.pop(index))
                return decoder
        noise_std = rounded_noise(frame.skin.skin, frame.noise_std)
        if noise_std is None:
            return None
        loop, started = asyncio.get_running_loop(), time.monotonic()

        def progress(step: str) -> None:
            log.info("decoder is being set up: %s", step)
            starting = Reason(ReasonCode.DECODER_STARTING, f"decoder is being set up: {step}")
            loop.call_soon_threadsafe(self._announce, starting)

        try:
            decoder = await loop.run_in_executor(pool, set_up, frame.skin.skin, self._options, noise_std, progress)
        except CANNOT_DECODE as error:
            log.error("%s: nothing is decoded: %s", plate, error_text(error))
            self._announce(None)
            if self._busy_with is not None:
                self._refuse(plate, Reason(ReasonCode.UNDECODABLE, f"nothing is decoded: {error_text(error)}"))
            return None
        self._announce(None)
        log.info("decoder %s for skins as of %s ready after %.1f s", decoder.name, plate, time.monotonic() - started)
        if len(self._decoders) == DECODERS_MAX:
            del self._decoders[0]
            log.warning("more than %d different skins or noises: decoders are set up again and again", DECODERS_MAX)
        self._decoders.append((geometry, decoder))
        return decoder


def _decode(decoder: SkinDecoder, signals: Floats, noise_std: Floats) -> SurfaceReading:
    try:
        return decoder.decode_alone(signals, noise_std)
    except Exception as error:  # noqa: BLE001  whatever one frame does, the next one is decoded
        return failed(decoder, error)
