"""Board ticks to UTC: which instant of the host's clock a tick count was, and how well that is known.

A ping exchange brackets one tick count between two readings of the host's monotonic clock. A line through the exchanges
with short round trips gives rate and offset; arrival times of frames are never used. See docs/time.md.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

_REMEMBERED = 64
_RATE_KNOWN_PPM = 10.0
_RATE_TOLERANCE_PPM = 100.0  # what a crystal may be off before anything was measured


class Exchange(NamedTuple):
    """One ping: host clock at sending, board ticks at its receipt, host clock at the answer."""

    sent_monotonic_ns: int
    board_ticks: int
    received_monotonic_ns: int

    @property
    def middle_monotonic_ns(self) -> int:
        return (self.sent_monotonic_ns + self.received_monotonic_ns) // 2

    @property
    def half_width_ns(self) -> int:
        return (self.received_monotonic_ns - self.sent_monotonic_ns + 1) // 2


class Instant(NamedTuple):
    """A moment in UTC and the bound of its error."""

    utc_ns: int
    uncertainty_ns: int


@dataclass(frozen=True, slots=True)
class _Line:
    origin: Exchange
    rate_ppm: float  # of the host's seconds per board second, less one
    rate_uncertainty_ppm: float
    offset_ns: float  # at the origin
    offset_uncertainty_ns: float


class BoardClock:
    """The relation between one boot of a board and the host's clocks.

    Parameters
    ----------
    reference_millihertz
        Nominal rate of the board's ticks.
    """

    def __init__(self, reference_millihertz: int) -> None:
        self._reference_millihertz = reference_millihertz
        self._exchanges: deque[Exchange] = deque(maxlen=_REMEMBERED)
        self._line: _Line | None = None
        self.utc_less_monotonic_ns = 0

    @property
    def known(self) -> bool:
        return self._line is not None

    @property
    def rate_ppm(self) -> float:
        """How much slower than nominal the board's ticks run; NaN until known to 10 ppm."""
        known = self._line is not None and self._line.rate_uncertainty_ppm <= _RATE_KNOWN_PPM
        return self._line.rate_ppm if self._line is not None and known else math.nan

    def add(self, exchange: Exchange, utc_less_monotonic_ns: int) -> None:
        """Take one ping exchange and the present difference of the host's two clocks."""
        self._exchanges.append(exchange)
        self.utc_less_monotonic_ns = utc_less_monotonic_ns
        self._line = self._fit()

    def at(self, board_ticks: int) -> Instant:
        """Return the instant of a tick count of this boot.

        Raises
        ------
        ValueError
            Before the first exchange.
        """
        if self._line is None:
            raise ValueError("the board's clock is not known before the first ping was answered")
        line = self._line
        elapsed_ns = self._nominal_ns(board_ticks - line.origin.board_ticks)
        correction_ns = line.offset_ns + elapsed_ns * line.rate_ppm * 1e-6
        monotonic_ns = line.origin.middle_monotonic_ns + elapsed_ns + round(correction_ns)
        uncertainty_ns = line.offset_uncertainty_ns + abs(elapsed_ns) * line.rate_uncertainty_ppm * 1e-6
        return Instant(monotonic_ns + self.utc_less_monotonic_ns, round(uncertainty_ns))

    def _nominal_ns(self, ticks: int) -> int:
        return ticks * 10**12 // self._reference_millihertz

    def _fit(self) -> _Line:
        """Fit a line through the exchanges whose round trip was short; the latest of those is its origin."""
        shortest = min(exchange.half_width_ns for exchange in self._exchanges)
        good = [e for e in self._exchanges if e.half_width_ns <= 2 * shortest + 20_000]
        origin = good[-1]
        # Relative to the origin all numbers are small, so that floating point loses nothing.
        elapsed_ns = [self._nominal_ns(e.board_ticks - origin.board_ticks) for e in good]
        excess_ns = [
            e.middle_monotonic_ns - origin.middle_monotonic_ns - t for e, t in zip(good, elapsed_ns, strict=True)
        ]
        mean_t, mean_x = sum(elapsed_ns) / len(good), sum(excess_ns) / len(good)
        spread = sum((t - mean_t) ** 2 for t in elapsed_ns)
        span_ns = max(elapsed_ns) - min(elapsed_ns)
        rate = (
            sum((t - mean_t) * (x - mean_x) for t, x in zip(elapsed_ns, excess_ns, strict=True)) / spread
            if spread
            else 0.0
        )
        rate_uncertainty_ppm = min(_RATE_TOLERANCE_PPM, 2e6 * shortest / span_ns) if span_ns else _RATE_TOLERANCE_PPM
        if abs(rate * 1e6) > _RATE_TOLERANCE_PPM:  # too short a span to tell the rate from a late answer
            rate, rate_uncertainty_ppm = 0.0, _RATE_TOLERANCE_PPM
        return _Line(
            origin=origin,
            rate_ppm=rate * 1e6,
            rate_uncertainty_ppm=rate_uncertainty_ppm,
            offset_ns=mean_x - rate * mean_t,
            # The answer cannot have come before the question: half a round trip bounds each, whatever the delays.
            offset_uncertainty_ns=float(origin.half_width_ns),
        )
