"""Decoding of several plates in one thread: each frame continues from the previous one of its plate."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

from resonator_daemon.estimate.surface.decoder_setup import EqualSkins
from resonator_daemon.measure.sensors.surface_decoding import Origin, SurfaceClient, SurfaceDecoding
from resonator_daemon.measure.sensors.surface_worker import Reply, SurfaceSettings, SurfaceWorker

Result = TypeVar("Result")


class DecodingThread:
    """Thread that sets up and runs the decoders of several plates in turn; equal skins share their matrices."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="decoding")
        self.turns = asyncio.Semaphore(2)  # in order of request: one frame is decoded, one is next
        self.skins = EqualSkins()

    async def run(self, work: Callable[[], Result]) -> Result:
        """Run work in the thread and return its result; if cancelled, wait until running work has ended."""
        future = self._executor.submit(work)
        try:
            return await asyncio.wrap_future(future)
        except asyncio.CancelledError:
            if not future.cancel():
                await asyncio.wait([asyncio.wrap_future(future)])
            raise

    async def end(self) -> None:
        """Stop the thread; wait until running work has ended."""
        await asyncio.to_thread(self._executor.shutdown)


class ThreadDecoding(SurfaceDecoding[Origin]):
    """Decoding by a thread that several plates share, one frame each in turn; to be used from the event loop only."""

    def __init__(
        self, settings: SurfaceSettings, client: SurfaceClient[Origin], name: str, thread: DecodingThread
    ) -> None:
        super().__init__(settings, client, name)
        self._thread = thread
        self._loop = asyncio.get_running_loop()
        self._worker = SurfaceWorker(settings, self._send, thread.skins.set_up)
        self._has_work = asyncio.Event()

    async def run(self) -> None:
        """Decode until cancelled, or until the set-up finds that the sites cannot be decoded."""
        try:
            while not self._undecodable:
                await self._has_work.wait()
                async with self._thread.turns:
                    if (request := self._next_request()) is not None:
                        await self._thread.run(partial(self._worker.serve, request))
                    else:
                        self._has_work.clear()
        finally:
            self._skip_all()

    def _wake(self) -> None:
        self._has_work.set()

    def _send(self, reply: Reply) -> None:
        self._loop.call_soon_threadsafe(self._received, reply)
