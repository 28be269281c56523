"""A limit on how often something may happen: so many times at once, and so many a second for long."""

from collections.abc import Callable


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
