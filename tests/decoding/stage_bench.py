"""What the tests of the stage share: a small skin, a stage that remembers, and decoders in place of the real one."""

import asyncio
import queue
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import numpy as np
from numpy.typing import NDArray
from skin_scenes import DEPTH_M, NU, E, grid, noisy, press

from resonator_daemon.decoding import Decoded, Patch
from resonator_daemon.decoding.skin import Skin, Wanted
from resonator_daemon.decoding.skin_contacts import SkinContact, SkinEvent
from resonator_daemon.decoding.skin_decoder import SkinDecoder, SurfaceReading
from resonator_daemon.decoding.stage import DecodingStage
from resonator_daemon.elastic import HalfSpace

Floats = NDArray[np.float64]

SHAPE, SITES = (12, 12), 144
SKIN = Skin(HalfSpace(E, NU), grid(SHAPE), DEPTH_M)
NOISE = np.tile([[2.0**-7], [2.0**-8], [2.0**-8]], SITES)  # powers of two, which rounding keeps
NOTHING = np.zeros((3, SITES))
LINEAR = Wanted(contact_physics=False)
NOBODY = SkinContact(1, Patch(*[np.zeros(2)] * 2, 0.0, *[np.zeros(3)] * 4, False, np.arange(1)), None, 0.0, 0.0)
NAN = np.nan
DEADLINE_S = 30.0  # far beyond what any of this takes: it ends a test that hangs


class Stage:
    """A stage, and what it has delivered and announced."""

    def __init__(self, wanted: Wanted = LINEAR, skin: Skin = SKIN) -> None:
        self.delivered: asyncio.Queue[tuple[str, SurfaceReading]] = asyncio.Queue()
        self.announced: list[str] = []
        self.called_in: set[threading.Thread] = set()
        self.maps: list[tuple[str, Decoded]] = []
        self.stage = self.make_stage(skin, wanted)

    def make_stage(self, skin: Skin, wanted: Wanted, before: SkinDecoder | None = None) -> DecodingStage[str]:
        return DecodingStage[str](skin, wanted, self._deliver_map, self._deliver, self._announce, before)

    def _deliver_map(self, origin: str, decoded: Decoded) -> None:
        self.called_in.add(threading.current_thread())
        self.maps.append((origin, decoded))

    def _deliver(self, origin: str, reading: SurfaceReading) -> None:
        self.called_in.add(threading.current_thread())
        self.delivered.put_nowait((origin, reading))

    def _announce(self, note: str) -> None:
        self.called_in.add(threading.current_thread())
        self.announced.append(note)

    @asynccontextmanager
    async def running(self) -> AsyncIterator["asyncio.Task[None]"]:
        task = asyncio.create_task(self.stage.run())
        try:
            yield task
        finally:
            task.cancel()
            await asyncio.wait([task])

    async def next(self) -> tuple[str, SurfaceReading]:
        return await asyncio.wait_for(self.delivered.get(), DEADLINE_S)

    async def read(self, signals: Floats, noise_std: Floats = NOISE) -> SurfaceReading:
        """Offer a frame and wait for what it gives."""
        self.stage.offer("frame", signals, noise_std)
        return (await self.next())[1]


class SubstituteDecoder:
    """In the place of the real one: knows its noise, and answers with the first signal as chi2."""

    name, shape, rebuild_wanted = "substitute", (SITES,), False

    def __init__(self, skin: Skin, wanted: Wanted, noise_std: Floats, progress: Callable[[str], None]) -> None:
        self.built_for = noise_std

    def fits(self, noise_std: Floats) -> bool:
        return bool(noise_std[0, 0] == self.built_for[0, 0])

    def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
        return Decoded(signals, signals, None, False, 0.0, float(signals[0, 0]), "ok", "")

    def read_contacts(self, decoded: Decoded) -> SurfaceReading:
        return SurfaceReading(self.name, decoded)

    def succeed(self, other: "SubstituteDecoder") -> tuple[SkinEvent, ...]:
        return ()

    def rebuild(self) -> None:
        pass


class HeldDecoder(SubstituteDecoder):
    """Decodes when it is told to."""

    entered: "queue.Queue[float]"
    released: threading.Semaphore
    threads: set[threading.Thread]

    def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
        self.threads.add(threading.current_thread())
        self.entered.put(float(signals[0, 0]))
        assert self.released.acquire(timeout=DEADLINE_S)
        return super().decode_map(signals, noise_std)

    @classmethod
    async def wait_until_entered(cls) -> float:
        return await asyncio.to_thread(cls.entered.get, timeout=DEADLINE_S)


def pressed(seed: int = 0) -> Floats:
    """A frame of 1 N with some shear in the middle."""
    signals = press(shear_newton=(0.3, 0.0), sites_m=SKIN.site_positions_m)
    return noisy(signals, np.random.default_rng(seed), NOISE)


def marked(value: float) -> Floats:
    return np.full((3, SITES), value)
