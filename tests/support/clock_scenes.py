"""Pings over links whose delays, and a board whose ticks, are known: the board's clock compared with the truth."""

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from resonator_daemon.board.session.clock import BoardClock, Exchange, Instant

NS = 1_000_000_000
REFERENCE_MILLIHERTZ = 250_000_000_000
UTC_LESS_MONOTONIC_NS = 1_789_000_000_000_000_000
_CREDIT_PINGS = 2  # unanswered; 64 bytes hold no more
_LOOK_NS = 20_000_000
_LOOK_BACK_NS = 5_000_000

Delay = Callable[[random.Random, float], float]  # from the time in ns at which it starts


@dataclass(frozen=True)
class Crystal:
    """Ticks as a function of the host's monotonic time, slower than nominal by `ppm` and a sine of `swing_ppm`."""

    ppm: float = 0.0
    swing_ppm: float = 0.0
    swing_ppm_per_s: float = 0.5  # steepest change
    ticks_at_zero: int = 10**15
    reference_millihertz: int = REFERENCE_MILLIHERTZ

    def rate_ppm(self, monotonic_ns: int) -> float:
        return self.ppm + self.swing_ppm * math.sin(self._turn(monotonic_ns))

    def ticks(self, monotonic_ns: int) -> int:
        slower_ns = round(monotonic_ns * self.ppm * 1e-6)
        if self.swing_ppm:
            amplitude_ns = 1e3 * self.swing_ppm**2 / self.swing_ppm_per_s
            slower_ns += round(amplitude_ns * (1 - math.cos(self._turn(monotonic_ns))))
        return self.ticks_at_zero + (monotonic_ns - slower_ns) * self.reference_millihertz // 10**12

    def _turn(self, monotonic_ns: int) -> float:
        return monotonic_ns / NS * self.swing_ppm_per_s / self.swing_ppm if self.swing_ppm else 0.0


def between(least_us: float, most_us: float) -> Delay:
    return lambda rng, _: rng.uniform(least_us, most_us) * 1e3


def clumped(period_ms: float, least_us: float = 20.0, most_us: float = 80.0) -> Delay:
    """Return answers collected on a grid, as a USB serial adapter does."""

    def delay(rng: random.Random, start_ns: float) -> float:
        ready_ns = start_ns + rng.uniform(least_us, most_us) * 1e3
        return (
            math.ceil(ready_ns / (period_ms * 1e6)) * period_ms * 1e6 - start_ns + rng.uniform(least_us, most_us) * 1e3
        )

    return delay


def sometimes(delay: Delay, share: float, least_us: float, most_us: float) -> Delay:
    """Return a delay to which now and then another is added."""
    return lambda rng, at: delay(rng, at) + (rng.uniform(least_us, most_us) * 1e3 if rng.random() < share else 0.0)


def busy_host(delay: Delay) -> Delay:
    """Return a delay with the pauses of a scheduler: one in twenty, 0.1 to 2 ms."""
    return sometimes(delay, 0.05, 100.0, 2000.0)


def memoryless(least_us: float, mean_us: float) -> Delay:
    return lambda rng, _: (least_us + rng.expovariate(1 / mean_us)) * 1e3


@dataclass(frozen=True)
class Scene:
    """A crystal, and the delays to the board and back."""

    name: str
    crystal: Crystal
    there: Delay
    back: Delay


class Look(NamedTuple):
    """Estimate of the clock for a tick count, with its error."""

    monotonic_ns: int
    error_ns: int
    estimate: Instant


def play(
    scene: Scene, seed: int, seconds: float, *, clock: BoardClock | None = None, start_ns: int = 5 * NS
) -> Iterator[Look]:
    """Exchange pings as the clock paces them; look 50 times a second at a tick count 5 ms old."""
    rng = random.Random(seed)
    clock = clock or BoardClock(scene.crystal.reference_millihertz)
    end_ns = start_ns + round(seconds * NS)
    due_ns, look_ns, at_board_ns, answered_ns = start_ns, start_ns + _LOOK_BACK_NS, 0, 0
    answers: list[Exchange] = []
    while True:
        now = min(due_ns, look_ns, answers[0].received_monotonic_ns if answers else due_ns)
        if now > end_ns:
            return
        if answers and answers[0].received_monotonic_ns == now:
            clock.add(answers.pop(0), UTC_LESS_MONOTONIC_NS)
            due_ns = min(due_ns, clock.ping_due_ns(now))
        elif now == due_ns:
            if len(answers) < _CREDIT_PINGS:  # streams, both ways: none overtakes
                at_board_ns = max(at_board_ns, now + round(scene.there(rng, now)))
                answered_ns = max(answered_ns, at_board_ns + round(scene.back(rng, at_board_ns)))
                answers.append(Exchange(now, scene.crystal.ticks(at_board_ns), answered_ns))
            due_ns = clock.ping_due_ns(now)
        else:
            look_ns += _LOOK_NS
            if clock.snapshot() is not None:
                then = now - _LOOK_BACK_NS
                estimate = clock.scale.at(scene.crystal.ticks(then))
                yield Look(then, estimate.monotonic_ns - then, estimate)


def scenes(ppm: float = 50.0) -> list[Scene]:
    """Return the links of the table."""
    crystal, warming = Crystal(ppm), Crystal(ppm, swing_ppm=20.0)
    quick = between(50, 150)
    grid = busy_host(sometimes(clumped(16.0), 0.01, 50e3, 50e3))
    return [
        Scene("plain, 100-300 us", crystal, quick, quick),
        Scene("plain, crystal warming", warming, quick, quick),
        Scene("busy host", crystal, busy_host(quick), busy_host(quick)),
        Scene("16 ms batches, late, busy", crystal, busy_host(quick), grid),
        Scene("the same, crystal warming", warming, busy_host(quick), grid),
        Scene("1 ms batches", warming, quick, clumped(1.0)),
        Scene("asymmetric, 0.1 and 2 ms", warming, quick, between(2000, 2100)),
        Scene("slow serial, 2 ms each way", warming, between(1950, 2050), between(1950, 2050)),
        Scene("wireless, 1 ms and more", warming, memoryless(1000, 3000), memoryless(1000, 3000)),
    ]
