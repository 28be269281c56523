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

_REBUILD_REST = 2.4  # times as long as a rebuild took: together at most 30 % of a core


class DecodingStage(Generic[Origin]):
    """Decodes in a thread of its own; signals that come while it is busy replace those that wait.

    A second thread follows contacts that move, as far as contact physics needs new matrices for that.

    Parameters
    ----------
    skin, wanted
    deliver
        Called on the event loop with what `offer` was given as origin, and the reading.
    announce
        Called on the event loop with what is being set up, with "" when that is done, and with the reason where these
        sites cannot be decoded.
    """

    def __init__(
        self,
        skin: Skin,
        wanted: Wanted,
        deliver: Callable[[Origin, SurfaceReading], None],
        announce: Callable[[str], None],
    ) -> None:
        self._skin = skin
        self._wanted = wanted
        self._deliver = deliver
        self._announce = announce
        self._decoder: SkinDecoder | None = None
        self._newest: tuple[Origin, Floats, Floats] | None = None
        self._offered = asyncio.Event()
        self._rebuild_due = asyncio.Event()
        self.frames_skipped = 0

    def offer(self, origin: Origin, signals: Floats, noise_std: Floats) -> None:
        """Take one frame, both arrays (3, sites), the dimensionless triple; never waits."""
        self.frames_skipped += self._newest is not None
        self._newest = (origin, signals, noise_std)
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
            if self._newest is None:
                continue
            (origin, signals, noise_std), self._newest = self._newest, None
            if self._decoder is None or not self._decoder.fits(noise_std):
                built_for = rounded_noise(self._skin, noise_std)
                if built_for is None:
                    self.frames_skipped += 1
                    continue
                started = time.monotonic()
                try:
                    decoder = await loop.run_in_executor(pool, self._build, built_for, loop)
                except (ValueError, ArithmeticError, MemoryError) as error:
                    log.error("nothing is decoded: %s", error)
                    self._announce(f"nothing is decoded: {error}")
                    return
                log.info("decoder %s ready after %.1f s", decoder.name, time.monotonic() - started)
                self._announce("")
                if self._decoder is not None:
                    ended = decoder.succeed(self._decoder)
                self._decoder = decoder
            reading = await loop.run_in_executor(pool, self._decode, self._decoder, signals, noise_std)
            if self._decoder.rebuild_wanted:
                self._rebuild_due.set()
            self._deliver(origin, replace(reading, events=ended + reading.events))
            ended = ()

    def _build(self, noise_std: Floats, loop: asyncio.AbstractEventLoop) -> SkinDecoder:
        def progress(step: str) -> None:
            log.info("decoder is being set up: %s", step)
            loop.call_soon_threadsafe(self._announce, f"decoder is being set up: {step}")

        return cached(
            (self._skin, self._wanted, noise_std),
            lambda: SkinDecoder(self._skin, self._wanted, noise_std, progress),
        )

    def _decode(self, decoder: SkinDecoder, signals: Floats, noise_std: Floats) -> SurfaceReading:
        try:
            return decoder.decode(signals, noise_std)
        except Exception as error:  # whatever one frame does, the next one is decoded
            log.exception("frame could not be decoded")
            unknown = np.full((3, *decoder.shape), np.nan)
            reason = f"decoder failed: {error!r}"
            decoded = Decoded(unknown, unknown, unknown, False, np.nan, np.nan, "rejected", reason)
            return SurfaceReading(decoder.name, decoded, events=decoder.reset())

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
