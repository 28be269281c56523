"""The streaming end of decoding: takes signals as they come, decodes the newest, and hands the results back."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.setup_cache import cached
from resonator_daemon.decoding.skin import Skin, Wanted
from resonator_daemon.decoding.skin_contacts import SkinEvent
from resonator_daemon.decoding.skin_decoder import SkinDecoder, SurfaceReading, rounded_noise

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Origin = TypeVar("Origin")

CANNOT_DECODE = (ValueError, ArithmeticError, MemoryError)
SWITCH_S = 5e-4  # of a thread that computes, before the event loop has its turn; Python's 5 ms are half a frame
_TOLD_MAX = 20
_told: set[str] = set()  # failures that the log knows of

_REBUILD_REST = 2.4  # times as long as a rebuild took: together at most 30 % of a core


class DecodingStage(Generic[Origin]):
    """Decodes in a thread of its own; signals that come while it is busy replace those that wait.

    A second thread follows contacts that move, as far as contact physics needs new matrices for that.

    Parameters
    ----------
    skin, wanted
    deliver_map
        Called on the event loop with what `offer` was given as origin, and the map, as soon as there is one.
    deliver
        Called after that with the origin and the whole reading, contacts included.
    announce
        Called on the event loop with what is being set up, with "" when that is done, and with the reason where these
        sites cannot be decoded.
    before
        `latest` of a stage that has ended, and whose place this one takes: numbers of contacts go on from there, and
        the first reading ends those that it followed.

    Attributes
    ----------
    frames_skipped
        A newer one came first, nothing told the noise yet, or the stage ended; all frames that were offered are
        delivered, here, or in `waiting`.
    frames_without_noise
        Of those skipped.
    """

    def __init__(
        self,
        skin: Skin,
        wanted: Wanted,
        deliver_map: Callable[[Origin, Decoded], None],
        deliver: Callable[[Origin, SurfaceReading], None],
        announce: Callable[[str], None],
        before: SkinDecoder | None = None,
    ) -> None:
        self._skin = skin
        self._wanted = wanted
        self._deliver_map = deliver_map
        self._deliver = deliver
        self._announce = announce
        self._decoder: SkinDecoder | None = None
        self._before = before
        self._busy = False
        self._newest: tuple[Origin, Floats, Floats] | None = None
        self._interruption = ""
        self._last_origin: Origin | None = None
        self._offered = asyncio.Event()
        self._rebuild_due = asyncio.Event()
        self.frames_skipped = 0
        self.frames_without_noise = 0

    @property
    def latest(self) -> SkinDecoder | None:
        """The decoder that followed contacts last, this stage's or one before."""
        return self._decoder or self._before

    @property
    def waiting(self) -> int:
        """Frames that are being decoded, or are next."""
        return self._busy + (self._newest is not None)

    def offer(self, origin: Origin, signals: Floats, noise_std: Floats) -> None:
        """Take one frame, both arrays (3, sites), the dimensionless triple; never waits."""
        self.frames_skipped += self._newest is not None
        self._newest = (origin, signals, noise_std)
        self._offered.set()

    def interrupt(self, reason: str) -> None:
        """End all contacts, because frames have stopped coming; never waits.

        Where there are any, a reading without a surface, but with their releases, is delivered with the last origin.
        """
        self._interruption = reason
        self._offered.set()

    async def run(self) -> None:
        """Decode until cancelled, or until it turns out that these sites cannot be decoded."""
        pool, second = (ThreadPoolExecutor(1, thread_name_prefix=name) for name in ("decoding", "rebuilding"))
        # One BLAS thread: a second one costs more in waiting than it saves on arrays of this size.
        with threadpool_limits(1, user_api="blas"):
            rebuilding = asyncio.create_task(self._rebuild(second), name="rebuilding")
            try:
                await self._run(pool)
            finally:
                self.frames_skipped += self.waiting
                self._busy, self._newest = False, None
                rebuilding.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await rebuilding
                for executor in (pool, second):  # a set-up cannot be interrupted; the event loop goes on meanwhile
                    await asyncio.to_thread(executor.shutdown)

    async def _run(self, pool: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        ended: tuple[SkinEvent, ...] = ()  # contacts of a decoder that was replaced
        while True:
            await self._offered.wait()
            self._offered.clear()
            if self._interruption:
                ended += await self._end_contacts(pool)
            if self._newest is None:
                continue
            (origin, signals, noise_std), self._newest = self._newest, None
            self._busy = True
            if self._decoder is None or not self._decoder.fits(noise_std):
                built_for = rounded_noise(self._skin, noise_std)
                if built_for is None:
                    self.frames_skipped += 1
                    self.frames_without_noise += 1
                    self._busy = False
                    continue
                started = time.monotonic()
                try:
                    decoder = await loop.run_in_executor(
                        pool, set_up, self._skin, self._wanted, built_for, announcer(self._announce, loop)
                    )
                except CANNOT_DECODE as error:
                    why = str(error) or repr(error)
                    log.error("nothing is decoded: %s", why)
                    self._announce(f"nothing is decoded: {why}")
                    return
                log.info("decoder %s ready after %.1f s", decoder.name, time.monotonic() - started)
                self._announce("")
                if (before := self.latest) is not None:
                    ended += decoder.succeed(before)
                self._decoder, self._before = decoder, None
            surface = await loop.run_in_executor(pool, decode_map, self._decoder, signals, noise_std)
            decoded = surface.decoded if isinstance(surface, SurfaceReading) else surface
            self._busy = False
            self._last_origin = origin
            self._deliver_map(origin, decoded)
            await asyncio.sleep(0)  # the map is on its way before the other thread wants the interpreter again
            if isinstance(surface, Decoded):
                surface = await loop.run_in_executor(pool, read_contacts, self._decoder, surface)
            if self._decoder.rebuild_wanted:
                self._rebuild_due.set()
            self._deliver(origin, replace(surface, events=ended + surface.events))
            ended = ()

    async def _end_contacts(self, pool: ThreadPoolExecutor) -> tuple[SkinEvent, ...]:
        """End contacts of an interruption; returns releases that go with a frame which has come meanwhile."""
        reason, self._interruption = self._interruption, ""
        if self._decoder is None or self._last_origin is None:
            return ()
        events = await asyncio.get_running_loop().run_in_executor(pool, self._decoder.reset)
        events = tuple(replace(event, reason=reason) for event in events)
        if not events or self._newest is not None:
            return events
        self._deliver(self._last_origin, nothing_decoded(self._decoder, "no_signal", reason, events))
        return ()

    async def _rebuild(self, pool: ThreadPoolExecutor) -> None:
        while True:
            await self._rebuild_due.wait()
            self._rebuild_due.clear()
            if self._decoder is not None:
                started = time.monotonic()
                try:
                    await asyncio.get_running_loop().run_in_executor(pool, self._decoder.rebuild)
                except Exception:  # until one succeeds, the decoder shows its map without contact physics
                    log.exception("contact physics could not follow a contact")
                await asyncio.sleep(_REBUILD_REST * (time.monotonic() - started))


def announcer(announce: Callable[[str], None], loop: asyncio.AbstractEventLoop) -> Callable[[str], None]:
    """Make what tells the log, and from a thread the event loop, what is being set up."""

    def progress(step: str) -> None:
        log.info("decoder is being set up: %s", step)
        loop.call_soon_threadsafe(announce, f"decoder is being set up: {step}")

    return progress


def set_up(skin: Skin, wanted: Wanted, noise_std: Floats, progress: Callable[[str], None]) -> SkinDecoder:
    """Build a decoder, or take it from the cache; one of CANNOT_DECODE where that is not possible."""
    try:
        return cached((skin, wanted, noise_std), lambda: SkinDecoder(skin, wanted, noise_std, progress))
    except CANNOT_DECODE:
        raise
    except Exception as error:  # whatever a skin from elsewhere is like, others can be decoded
        log.exception("decoder could not be set up")
        raise ValueError(f"decoder could not be set up: {error!r}") from error


def failed(decoder: SkinDecoder, error: Exception) -> SurfaceReading:
    """Return what is to be said of a frame whose decoding failed."""
    if repr(error) not in _told and len(_told) < _TOLD_MAX:  # what one frame does, all that follow may do
        _told.add(repr(error))
        log.error("frames cannot be decoded", exc_info=error)
    return nothing_decoded(decoder, "rejected", f"decoder failed: {error!r}", decoder.reset())


def nothing_decoded(decoder: SkinDecoder, status: str, reason: str, events: tuple[SkinEvent, ...]) -> SurfaceReading:
    """Return a reading without a surface, but with how contacts end."""
    unknown = np.full((3, *decoder.shape), np.nan)
    decoded = Decoded(unknown, unknown, unknown, False, np.nan, np.nan, status, reason)
    return SurfaceReading(decoder.name, decoded, events=events)


def decode_map(decoder: SkinDecoder, signals: Floats, noise_std: Floats) -> Decoded | SurfaceReading:
    """Return the map; where that fails, all that is to be said of the frame."""
    try:
        return decoder.decode_map(signals, noise_std)
    except Exception as error:  # noqa: BLE001  whatever one frame does, the next one is decoded
        return failed(decoder, error)


def read_contacts(decoder: SkinDecoder, decoded: Decoded) -> SurfaceReading:
    """Return map and contacts; where that fails, all that is to be said of the frame."""
    try:
        return decoder.read_contacts(decoded)
    except Exception as error:  # noqa: BLE001
        return failed(decoder, error)
