"""Board ticks to the host's clocks: which instant a tick count was, and how well that is known.

A ping exchange brackets one tick count between two readings of the host's monotonic clock. The lines from ticks to host
time that all exchanges allow give the instant and the bound of its error; arrival times of frames are never used.
Callers receive the host's time as an argument, so that a recording can hand it again. See docs/explanation/time.md.
"""

import math
import time
from collections import deque
from typing import NamedTuple

from resonator_daemon.board.session.tick_bounds import RATE_WANDER_PER_S, BoundsSnapshot, TickBounds

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


_RATE_KNOWN_PPM = 10.0
_CRYSTAL_RATES = (-200e-6, 200e-6)
TOLERANCE_PPM = 1000.0  # a crystal, and the 500 ppm by which NTP may slew the host's clock
_LIKELY_RATES = (-0.01, 0.01)  # beyond, one exchange is rather wrong than the rate
_POSSIBLE_RATES = (-0.9, 9.0)
_LINES_KEPT, _LINES_APART_NS = 8, 8_000_000_000
_VOTES, _VOTES_UNLIKELY = 3, 8
_COUNT_CERTAIN = 16
_NS = 1_000_000_000
_SUSPEND_NS = 50_000_000  # no host wakes sooner; less is a pause between two readings of its clocks

_ATTEMPTS = 3
_AT_ONCE_NS = 5_000


class HostTime(NamedTuple):
    """One moment on the host's clocks."""

    monotonic_ns: int
    utc_less_monotonic_ns: int
    boottime_less_monotonic_ns: int  # grows while the host sleeps

    @property
    def utc_ns(self) -> int:
        return self.monotonic_ns + self.utc_less_monotonic_ns


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


class Exchange(NamedTuple):
    """One ping: host clock at sending, board ticks at its receipt, host clock at the answer."""

    sent_monotonic_ns: int
    board_ticks: int
    received_monotonic_ns: int


class Instant(NamedTuple):
    """A moment on the host's clocks and the bound of its error; durations are differences of monotonic times."""

    utc_ns: int
    uncertainty_ns: int
    monotonic_ns: int = 0
    boottime_ns: int = 0  # goes on while the host sleeps


class Line(NamedTuple):
    """From nominal board time to host time, drawn at one exchange; a rate is what a nominal second has too many."""

    nominal_ns: int
    monotonic_ns: int
    uncertainty_ns: float
    rate: float
    rate_uncertainty: float


class TickScale(NamedTuple):
    """From the tick counts of one boot to the host's clocks, as known at one moment."""

    reference_millihertz: int
    origin_ticks: int
    line: Line
    utc_less_monotonic_ns: int
    boottime_less_monotonic_ns: int

    def at(self, board_ticks: int) -> Instant:
        """Return the instant of a tick count."""
        reference_millihertz, origin_ticks, line, utc_less_ns, boottime_less_ns = self
        nominal_ns, drawn_ns, uncertainty_ns, rate, rate_uncertainty = line
        elapsed_ns = (board_ticks - origin_ticks) * 10**12 // reference_millihertz - nominal_ns
        monotonic_ns = drawn_ns + elapsed_ns + round(elapsed_ns * rate)
        away_ns = abs(elapsed_ns)
        uncertainty_ns += away_ns * (rate_uncertainty + away_ns * (RATE_WANDER_PER_S / (2 * _NS)))
        return Instant(
            monotonic_ns + utc_less_ns, math.ceil(uncertainty_ns), monotonic_ns, monotonic_ns + boottime_less_ns
        )


class _Bounds(NamedTuple):
    nominal_ns: int
    least_ns: int
    most_ns: int


class ClockSnapshot(NamedTuple):
    """State of a `BoardClock`, except when the next ping should leave."""

    origin: Exchange
    agreed: BoundsSnapshot
    rival: BoundsSnapshot | None
    votes: int
    utc_less_monotonic_ns: int
    boottime_less_monotonic_ns: int
    asleep_ns: int
    lines: tuple[Line, ...]


class BoardClock:
    """The relation between one boot of a board and the host's clocks.

    Parameters
    ----------
    reference_millihertz
        Nominal rate of the board's ticks.

    Attributes
    ----------
    utc_less_monotonic_ns
        Difference of the host's two clocks at the latest exchange.
    outliers
        Exchanges that contradicted those before them.
    restarts
        How often the relation was begun again: after a suspend, or because such exchanges agreed with each other.
    """

    def __init__(self, reference_millihertz: int) -> None:
        self._reference_millihertz = reference_millihertz
        self._origin: Exchange | None = None
        self._agreed: TickBounds | None = None  # by all but outliers
        self._rival: TickBounds | None = None
        self._votes = 0
        self._boottime_less_monotonic_ns = 0
        self._asleep_ns = 0
        self._line: Line | None = None
        self._lines: deque[Line] = deque(maxlen=_LINES_KEPT)
        self._pacing = PingPacing()
        self.utc_less_monotonic_ns = 0
        self.outliers = 0
        self.restarts = 0

    def snapshot(self) -> ClockSnapshot | None:
        """Return the state; None before the first exchange."""
        if self._origin is None or self._agreed is None:
            return None
        return ClockSnapshot(
            self._origin,
            self._agreed.snapshot(),
            self._rival.snapshot() if self._rival is not None else None,
            self._votes,
            self.utc_less_monotonic_ns,
            self._boottime_less_monotonic_ns,
            self._asleep_ns,
            tuple(self._lines),
        )

    def restore(self, snapshot: ClockSnapshot) -> None:
        """Set the state of a new clock; outliers and restarts are not part of it."""
        self._origin = snapshot.origin
        self._agreed = TickBounds.restore(snapshot.agreed)
        self._rival = TickBounds.restore(snapshot.rival) if snapshot.rival is not None else None
        self._votes = snapshot.votes
        self.utc_less_monotonic_ns = snapshot.utc_less_monotonic_ns
        self._boottime_less_monotonic_ns = snapshot.boottime_less_monotonic_ns
        self._asleep_ns = snapshot.asleep_ns
        self._lines.extend(snapshot.lines)
        self._line = self._draw(snapshot.origin, self._agreed)

    @property
    def rate_ppm(self) -> float:
        """How much slower than nominal the board's ticks ran over the last minute or so; NaN until known to 10 ppm."""
        now = self._line
        if now is None:
            return math.nan
        known = [
            ((now.uncertainty_ns + then.uncertainty_ns) / (now.nominal_ns - then.nominal_ns), then)
            for then in tuple(self._lines)  # the reader's thread adds to them meanwhile
            if then.nominal_ns < now.nominal_ns
        ]
        uncertainty, then = min(known, default=(math.inf, now))
        if uncertainty > _RATE_KNOWN_PPM * 1e-6:
            return math.nan
        elapsed_ns = now.nominal_ns - then.nominal_ns
        return (now.monotonic_ns - then.monotonic_ns - elapsed_ns) / elapsed_ns * 1e6

    @property
    def rate_beyond_tolerance(self) -> tuple[float, float] | None:
        """Rate and its uncertainty in ppm, where the ticks are certainly further off nominal than 1000 ppm."""
        if self._agreed is None or self._rival is not None or self._agreed.count < _COUNT_CERTAIN:
            return None
        least_ppm, most_ppm = 1e6 * self._agreed.lines.least_rate, 1e6 * self._agreed.lines.most_rate
        if least_ppm <= TOLERANCE_PPM and most_ppm >= -TOLERANCE_PPM:
            return None
        return (least_ppm + most_ppm) / 2, (most_ppm - least_ppm) / 2

    def add(self, exchange: Exchange, utc_less_monotonic_ns: int, *, boottime_less_monotonic_ns: int = 0) -> None:
        """Add one ping exchange, with the present differences of the host's clocks.

        `boottime_less_monotonic_ns` grows while the host sleeps: then, the board counted on and the monotonic clock did
        not, and the relation begins again.
        """
        self.utc_less_monotonic_ns = utc_less_monotonic_ns
        if exchange.received_monotonic_ns < exchange.sent_monotonic_ns:
            self.outliers += 1
            return
        if self._origin is None:
            self._origin = exchange
            self._boottime_less_monotonic_ns = boottime_less_monotonic_ns
        origin = self._origin
        slept_ns = abs(boottime_less_monotonic_ns - self._boottime_less_monotonic_ns)
        self._boottime_less_monotonic_ns = boottime_less_monotonic_ns
        ticks = exchange.board_ticks - origin.board_ticks
        nominal_ns = self._nominal_ns(ticks)
        bounds = _Bounds(
            nominal_ns,
            exchange.sent_monotonic_ns - origin.sent_monotonic_ns - self._nominal_ns(ticks + 1) - 1,  # rounded down
            exchange.received_monotonic_ns - origin.sent_monotonic_ns - nominal_ns,
        )
        if self._agreed is None:
            agreed = self._begin(TickBounds(_LIKELY_RATES, *bounds))
        elif slept_ns >= _SUSPEND_NS:
            self._asleep_ns = slept_ns
            self.restarts += 1
            agreed = self._begin(TickBounds(_LIKELY_RATES, *bounds))
        elif self._asleep_ns:
            self._asleep_ns = 0
            agreed = self._agreed
            if not agreed.add(*bounds):  # the ping before was received before the host fell asleep
                agreed = self._begin(TickBounds(_LIKELY_RATES, *bounds))
        else:
            agreed = self._weigh(self._agreed, bounds)
        self._line = line = self._draw(origin, agreed)
        if not self._lines or line.nominal_ns - self._lines[-1].nominal_ns >= _LINES_APART_NS:
            self._lines.append(line)
        before_next_ns = line.uncertainty_ns + line.rate_uncertainty * _NS
        self._pacing.update(exchange.received_monotonic_ns, before_next_ns, agreed.count)

    def _begin(self, agreed: TickBounds) -> TickBounds:
        self._agreed = agreed
        self._rival = None
        self._lines.clear()
        return agreed

    def _weigh(self, agreed: TickBounds, bounds: _Bounds) -> TickBounds:
        """Weigh bounds that may contradict those before; contradictions that agree with each other win in the end."""
        fits = agreed.add(*bounds)
        fits_rival = self._rival is not None and self._rival.add(*bounds)
        if fits:
            if not fits_rival:
                self._rival = None
            return agreed
        self.outliers += 1
        if self._rival is None or not fits_rival:
            self._rival = TickBounds(_POSSIBLE_RATES, *bounds)
            self._votes = 0
        self._votes += 1
        likely = self._rival.narrowed(_LIKELY_RATES) is not None
        if self._votes < (_VOTES if likely else _VOTES_UNLIKELY):
            return agreed
        self.restarts += 1
        return self._begin(self._rival)

    def _draw(self, origin: Exchange, bounds: TickBounds) -> Line:
        """Return the middle of the lines that a crystal may follow, and what is in doubt about it."""
        lines = bounds.narrowed(_CRYSTAL_RATES) or bounds.lines
        middle_ns = (lines.least_ns + lines.most_ns) / 2
        uncertainty_ns = (lines.most_ns - lines.least_ns) / 2 + self._asleep_ns
        rate = (lines.least_rate + lines.most_rate) / 2
        if self._rival is not None:
            other = self._rival.lines
            less_ns = other.excess_ns - lines.excess_ns - middle_ns - (other.nominal_ns - lines.nominal_ns) * rate
            uncertainty_ns = max(uncertainty_ns, abs(less_ns + other.least_ns), abs(less_ns + other.most_ns))
        return Line(
            lines.nominal_ns,
            origin.sent_monotonic_ns + lines.nominal_ns + lines.excess_ns + round(middle_ns),
            uncertainty_ns,
            rate,
            (lines.most_rate - lines.least_rate) / 2,
        )

    @property
    def scale(self) -> TickScale:
        """The relation as it is now; exchanges to come do not change it.

        Raises
        ------
        ValueError
            Before the first exchange.
        """
        if self._line is None or self._origin is None:
            raise ValueError("the board's clock is not known before the first ping was answered")
        return TickScale(
            self._reference_millihertz,
            self._origin.board_ticks,
            self._line,
            self.utc_less_monotonic_ns,
            self._boottime_less_monotonic_ns,
        )

    def ping_due_ns(self, now_monotonic_ns: int) -> int:
        """Return the monotonic time at which the ping after one that leaves now should leave."""
        return self._pacing.next_ns(now_monotonic_ns)

    def _nominal_ns(self, ticks: int) -> int:
        return ticks * 10**12 // self._reference_millihertz
