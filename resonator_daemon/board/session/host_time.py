"""The host's clocks, read together; callers receive the time as an argument, so that a recording can hand it again."""

import time
from typing import NamedTuple


class HostTime(NamedTuple):
    """One moment on the host's clocks."""

    monotonic_ns: int
    utc_less_monotonic_ns: int
    boottime_less_monotonic_ns: int  # grows while the host sleeps

    @property
    def utc_ns(self) -> int:
        return self.monotonic_ns + self.utc_less_monotonic_ns


_ATTEMPTS = 3
_AT_ONCE_NS = 5_000


def read_host_time() -> HostTime:
    """Read the clocks; again where this thread had to wait between two of them, which would bend UTC by that."""
    best, best_ns = None, 0
    for _ in range(_ATTEMPTS):
        before_ns = time.monotonic_ns()
        utc_ns = time.time_ns()
        boottime_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        after_ns = time.monotonic_ns()
        if best is None or after_ns - before_ns < best_ns:
            best_ns = after_ns - before_ns
            middle_ns = (before_ns + after_ns) // 2
            best = HostTime(after_ns, utc_ns - middle_ns, boottime_ns - middle_ns)
        if best_ns < _AT_ONCE_NS:
            break
    assert best is not None  # noqa: S101 - at least one attempt
    return best
