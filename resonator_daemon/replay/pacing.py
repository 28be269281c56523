"""How fast recorded time passes in a replay."""

import asyncio
import sys
import time
from collections.abc import Awaitable, Callable
from typing import Final, Protocol

from resonator_daemon.replay.recorded_pipeline import Moment
from resonator_daemon.session.host_time import HostTime

_AT_ONCE_S: Final = 1e-3  # a wait takes longer than this


class Pacing(Protocol):
    """Waits for each moment's turn."""

    async def wait_for(self, moment: Moment) -> None: ...


class AtSpeed:
    """Recorded time passes this many times as fast as it did, from the first moment on.

    Parameters
    ----------
    speed
        Above 0; infinite: as fast as it goes.
    clock_ns, sleep
        Of the present.
    """

    def __init__(
        self,
        speed: float,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._speed = speed
        self._clock_ns = clock_ns
        self._sleep = sleep
        self._begun: tuple[int, int] | None = None  # on the clock, and in recorded time

    async def wait_for(self, moment: Moment) -> None:
        if self._begun is None:
            self._begun = self._clock_ns(), moment.now.monotonic_ns
        clock_ns, recorded_ns = self._begun
        due_ns = clock_ns + (moment.now.monotonic_ns - recorded_ns) / self._speed
        left_s = (due_ns - self._clock_ns()) * 1e-9
        await self._sleep(left_s if left_s > _AT_ONCE_S else 0.0)


class StepByStep:
    """Prints on stderr what comes next, and waits for Enter on a terminal."""

    def __init__(self, begun: HostTime) -> None:
        self._begun_ns = begun.monotonic_ns

    async def wait_for(self, moment: Moment) -> None:
        at_s = (moment.now.monotonic_ns - self._begun_ns) * 1e-9
        topics = ", ".join(published.topic.path for published in moment.messages)
        sys.stderr.write(f"{at_s:.3f} s  {topics}  [Enter] ")
        sys.stderr.flush()
        await _enter()


async def _enter() -> None:
    """Wait for a line on stdin; EOFError: no more of them come."""
    loop = asyncio.get_running_loop()
    there = asyncio.Event()
    loop.add_reader(sys.stdin.fileno(), there.set)
    try:
        await there.wait()
    finally:
        loop.remove_reader(sys.stdin.fileno())
    if not sys.stdin.readline():
        raise EOFError
