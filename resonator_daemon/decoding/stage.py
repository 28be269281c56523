"""The streaming end of decoding: takes signals as they come, decodes the newest, and hands the results back."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.fourier import FourierDecoder
from resonator_daemon.elastic import HalfSpace

Floats = NDArray[np.float64]
Origin = TypeVar("Origin")

_NOISE_CHANGE = 1.5  # a smaller one hardly changes what is decoded


class DecodingStage(Generic[Origin]):
    """Decodes in a thread of its own; signals that come while it is busy replace those that wait.

    Parameters
    ----------
    half_space, shape, pitch_m, depth_m
        Of the skin and of its grid of sites, as `FourierDecoder` takes them.
    deliver
        Called on the event loop with what `offer` was given as origin, and the result.
    """

    name = "fourier"

    def __init__(
        self,
        half_space: HalfSpace,
        shape: tuple[int, int],
        pitch_m: float,
        depth_m: float,
        deliver: Callable[[Origin, Decoded], None],
    ) -> None:
        self._half_space = half_space
        self._shape = shape
        self._pitch_m = pitch_m
        self._depth_m = depth_m
        self._deliver = deliver
        self._decoder: FourierDecoder | None = None
        self._channel_std: Floats | None = None  # what the decoder was built for
        self._newest: tuple[Origin, Floats, Floats] | None = None
        self._offered = asyncio.Event()
        self.frames_skipped = 0

    def offer(self, origin: Origin, signals: Floats, noise_std: Floats) -> None:
        """Take one frame, both arrays (3, sites), the dimensionless triple; never waits."""
        self.frames_skipped += self._newest is not None
        self._newest = (origin, signals, noise_std)
        self._offered.set()

    async def run(self) -> None:
        """Decode until cancelled."""
        # One BLAS thread: a second one costs more in waiting than it saves on arrays of this size.
        with ThreadPoolExecutor(1, thread_name_prefix="decoding") as pool, threadpool_limits(1, user_api="blas"):
            while True:
                await self._offered.wait()
                self._offered.clear()
                if self._newest is None:
                    continue
                (origin, signals, noise_std), self._newest = self._newest, None
                decoded = await asyncio.get_running_loop().run_in_executor(pool, self._decode, signals, noise_std)
                if decoded is not None:
                    self._deliver(origin, decoded)

    def _decode(self, signals: Floats, noise_std: Floats) -> Decoded | None:
        channel_std = _median_by_channel(noise_std)
        # The board states its noise with the signals; a decoder serves until that has changed.
        if channel_std is not None and (self._channel_std is None or _differ(channel_std, self._channel_std)):
            self._decoder = FourierDecoder(self._half_space, self._shape, self._pitch_m, self._depth_m, channel_std)
            self._channel_std = channel_std
        if self._decoder is None:
            return None
        return self._decoder.decode(signals.reshape(3, *self._shape), displacement=True)


def _median_by_channel(noise_std: Floats) -> Floats | None:
    known = np.isfinite(noise_std)
    if not known.any(axis=1).all():
        return None
    return np.array([np.median(row[keep]) for row, keep in zip(noise_std, known, strict=True)])


def _differ(std: Floats, other: Floats) -> bool:
    return bool((np.maximum(std / other, other / std) > _NOISE_CHANGE).any())
