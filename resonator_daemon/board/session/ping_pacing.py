"""Times of pings: frequent while the estimate improves, else about one per second, with jitter."""

import math

_TARGET_NS = 100_000
_NEAR_BEST = 1.2
_SETTLING = 800  # exchanges: 8 s of them
_REMEMBERED_NS = 30_000_000_000
# A span above 16 ms, so that the spread covers the period of whatever collects answers: 1, 5, 10 or 16 ms.
_LEARNING_NS, _LEARNING_SPAN_NS = 1_500_000, 17_000_000
_RAPID_NS, _RAPID_SPAN_NS = 11_500_000, 17_000_000
_CALM_NS, _CALM_SPAN_NS = 961_500_000, 17_000_000
_GOLDEN_64 = 0x9E3779B97F4A7C15


class PingPacing:
    """Follows what the last exchanges were worth.

    An uncertainty above 100 us asks for pings every 10 ms at first, then every 20 ms, unless they no longer help: a
    link of constant 2 ms each way will never do better, and is not pinged for it.
    """

    def __init__(self) -> None:
        self._learning = self._rapid = True
        self._best_ns = self._best_before_ns = math.inf
        self._since_ns: int | None = None

    def update(self, now_monotonic_ns: int, uncertainty_ns: float, count: int) -> None:
        """Set the uncertainty that will be reached before the next calm ping, and how many exchanges it rests on."""
        if self._since_ns is None or now_monotonic_ns - self._since_ns > _REMEMBERED_NS:
            self._best_before_ns, self._best_ns = self._best_ns, math.inf
            self._since_ns = now_monotonic_ns
        self._best_ns = min(self._best_ns, uncertainty_ns)
        self._learning = count < _SETTLING
        reachable_ns = 0.0 if self._learning else _NEAR_BEST * min(self._best_ns, self._best_before_ns)
        self._rapid = uncertainty_ns > max(_TARGET_NS, reachable_ns)

    def next_ns(self, now_monotonic_ns: int) -> int:
        """Return when the ping after one at this time should leave; the jitter is a hash of the time."""
        if not self._rapid:
            base_ns, span_ns = _CALM_NS, _CALM_SPAN_NS
        elif self._learning:
            base_ns, span_ns = _LEARNING_NS, _LEARNING_SPAN_NS
        else:
            base_ns, span_ns = _RAPID_NS, _RAPID_SPAN_NS
        share_64 = now_monotonic_ns * _GOLDEN_64 % 2**64
        return now_monotonic_ns + base_ns + (span_ns * share_64 >> 64)
