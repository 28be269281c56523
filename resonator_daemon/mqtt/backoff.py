"""Exponential back-off with jitter between attempts to connect."""

import random


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
