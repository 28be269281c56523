"""How often something may happen: pauses between attempts, a limit with bursts, a lower rate of messages."""

import random
from collections.abc import Callable
from typing import Final

_NS_PER_S: Final = 1e9


class Backoff:
    """Pauses that double from the first one on, each cut to a limit and shortened by up to half at random."""

    def __init__(self, first_s: float) -> None:
        self._first_s = first_s
        self._next_s = first_s

    def next_s(self, longest_s: float) -> float:
        """Return the next pause; the limit may differ from one to the next."""
        pause_s = min(self._next_s, longest_s)
        self._next_s = 2 * pause_s
        return pause_s * random.uniform(0.5, 1.0)

    def reset(self) -> None:
        self._next_s = self._first_s


class TokenBucket:
    """Holds `at_once` tokens at most and gets `per_second` back, by a clock in seconds."""

    def __init__(self, at_once: int, per_second: float, clock: Callable[[], float]) -> None:
        self._at_once = float(at_once)
        self._per_second = per_second
        self._clock = clock
        self._tokens = self._at_once
        self._counted_s = clock()

    def try_acquire(self) -> bool:
        """Remove a token; return False if there is none."""
        now_s = self._clock()
        self._tokens = min(self._at_once, self._tokens + (now_s - self._counted_s) * self._per_second)
        self._counted_s = now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True


class Decimator:
    """Lets the first message of each period pass, by the messages' own time.

    Periods are cut at multiples of their length, so that messages of a steady rate pass at a steady rate, too,
    whatever their times scatter by.

    Raises
    ------
    ValueError
        The rate is not above 0.
    """

    def __init__(self, rate_hz: float) -> None:
        if not rate_hz > 0.0:
            raise ValueError(f"rate {rate_hz!r} Hz: must be above 0")
        self._period_ns = max(round(_NS_PER_S / rate_hz), 1)
        self._last: int | None = None

    def lets_pass(self, t_ns: int) -> bool:
        period = t_ns // self._period_ns
        if self._last is not None and self._last - 1 <= period <= self._last:  # earlier still: the clock was set back
            return False
        self._last = period
        return True
