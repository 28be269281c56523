"""Which lines from ticks to host time all exchanges allow: two convex hulls, relaxed by what a rate may wander.

Every exchange bounds the host's time of one tick count from below and from above, whatever its delays were. Lines that
keep all bounds form a polygon (Duda, Harrus, Haddad and Bernard, "Estimating global time in distributed systems",
1987); a long trip is merely a loose bound. A rate that changes by at most W a second leaves its present line by no more
than W/2 times the square of the age, so a bound is loosened by that. A parabola and a change of its apex differ by a
straight line, which moves no point into or out of a convex hull: a bound once dropped can never bind again, and the few
vertices that are left hold what thousands of exchanges gave.
"""

from typing import NamedTuple, Self

RATE_WANDER_PER_S = 0.5e-6  # a bare crystal in a draught or under a warming hand
_NS = 1_000_000_000
_RELAX_NS = round(2 * _NS / RATE_WANDER_PER_S)  # age squared over this is the loosening: ns * ns / ns
_WINDOW_NS = 128 * _NS
_VERTICES = 16


class Point(NamedTuple):
    """A bound on the excess of host time over nominal board time, at a nominal board time."""

    nominal_ns: int
    excess_ns: int


class Lines(NamedTuple):
    """The lines that keep all bounds: their extremes at the newest one; rates in ns per ns."""

    nominal_ns: int
    excess_ns: int
    least_ns: float  # beyond excess_ns, as is the next
    most_ns: float
    least_rate: float
    most_rate: float


class BoundsSnapshot(NamedTuple):
    """State of `TickBounds`: the vertices of both hulls, and what is derived from them."""

    rates: tuple[float, float]
    floor: tuple[Point, ...]
    ceiling: tuple[Point, ...]
    lines: Lines
    exchanges: int


class TickBounds:
    """Bounds that agree with each other; there is at least one.

    Parameters
    ----------
    rates
        Least and most excess of host time per nominal board time that is thought possible.
    nominal_ns, least_ns, most_ns
        The first bounds, as of `add`.
    """

    def __init__(self, rates: tuple[float, float], nominal_ns: int, least_ns: int, most_ns: int) -> None:
        self._rates = rates
        self._floor = [Point(nominal_ns, least_ns)]
        self._ceiling = [Point(nominal_ns, -most_ns)]  # upside down, so that one hull routine serves both
        self.lines = Lines(nominal_ns, least_ns, 0.0, float(most_ns - least_ns), *rates)
        self.count = 1

    def snapshot(self) -> BoundsSnapshot:
        return BoundsSnapshot(self._rates, tuple(self._floor), tuple(self._ceiling), self.lines, self.count)

    @classmethod
    def restore(cls, snapshot: BoundsSnapshot) -> Self:
        bounds = cls(snapshot.rates, *snapshot.floor[-1], snapshot.ceiling[-1].excess_ns)
        bounds._floor, bounds._ceiling = list(snapshot.floor), list(snapshot.ceiling)
        bounds.lines, bounds.count = snapshot.lines, snapshot.exchanges
        return bounds

    def add(self, nominal_ns: int, least_ns: int, most_ns: int) -> bool:
        """Add the bounds of one exchange; return False, and change nothing, where they contradict the others."""
        # However long the silence: the loosening of old bounds would in the end allow anything.
        floor_at, floor_ns = self._floor[-1]
        ceiling_at, ceiling_ns = self._ceiling[-1]
        if (
            nominal_ns < self.lines.nominal_ns
            or most_ns - floor_ns < self._rates[0] * (nominal_ns - floor_at)
            or least_ns + ceiling_ns > self._rates[1] * (nominal_ns - ceiling_at)
        ):
            return False
        floor = _with_point(self._floor, Point(nominal_ns, least_ns))
        ceiling = _with_point(self._ceiling, Point(nominal_ns, -most_ns))
        lines = _lines(floor, ceiling, self._rates)
        if lines is None:
            return False
        self._floor, self._ceiling, self.lines = floor, ceiling, lines
        self.count = self.count + 1 if len(floor) > 1 else 1  # after long silence there is nothing to agree with
        return True

    def narrowed(self, rates: tuple[float, float]) -> Lines | None:
        """Return the lines with a rate in this range only; None where there is none."""
        least, most = max(rates[0], self.lines.least_rate), min(rates[1], self.lines.most_rate)
        if (least, most) == (self.lines.least_rate, self.lines.most_rate):
            return self.lines
        return _lines(self._floor, self._ceiling, (least, most))


def _with_point(hull: list[Point], new: Point) -> list[Point]:
    """Return the upper hull with a point at its right end, in exact integers."""
    kept = [point for point in hull if point.nominal_ns > new.nominal_ns - _WINDOW_NS]
    if kept and kept[-1].nominal_ns == new.nominal_ns:
        new = max(new, kept.pop())
    while len(kept) >= 2:
        (x0, z0), (x1, z1) = _relative_to(kept[-2], new), _relative_to(kept[-1], new)
        if z1 * x0 < z0 * x1:  # the middle point lies above the chord: both x are negative
            break
        kept.pop()
    kept.append(new)
    if len(kept) > _VERTICES:  # delays all alike: the parabola alone keeps every bound
        del kept[min(range(1, _VERTICES), key=lambda at: _height(*kept[at - 1 : at + 2]))]
    return kept


def _height(left: Point, middle: Point, right: Point) -> int:
    """Return how far a vertex lies above the chord of its neighbours."""
    (x0, z0), (x1, z1) = _relative_to(left, right), _relative_to(middle, right)
    return z1 - z0 * x1 // x0


def _relative_to(point: Point, apex: Point) -> tuple[int, int]:
    """Return a point relative to another, loosened by its age, heights in units of 1 / _RELAX_NS."""
    age = point.nominal_ns - apex.nominal_ns
    return age, (point.excess_ns - apex.excess_ns) * _RELAX_NS - age * age


def _relative(hull: list[Point], apex: Point) -> list[tuple[float, float]]:
    """Return the points of a hull relative to one, loosened by their ages; so small, floating point loses nothing."""
    at_ns, near_ns = apex
    return [(float(age := x - at_ns), y - near_ns - age * age / _RELAX_NS) for x, y in hull]


def _lines(floor: list[Point], ceiling: list[Point], rates: tuple[float, float]) -> Lines | None:
    """Return the extremes of the lines between two hulls, with rates within `rates`; None where there is none."""
    now_ns, near_ns = floor[-1]
    below = _relative(floor, floor[-1])
    above = [(x, -y) for x, y in _relative(ceiling, Point(now_ns, -near_ns))]
    least, most = rates
    for xb, yb in below:
        for xa, ya in above:  # a hundred pairs at each exchange: compared without the calls of min and max
            if xa > xb:
                if (rate := (ya - yb) / (xa - xb)) < most:
                    most = rate
            elif xa < xb and (rate := (yb - ya) / (xb - xa)) > least:
                least = rate
    if least > most:
        return None
    return Lines(
        nominal_ns=now_ns,
        excess_ns=near_ns,
        least_ns=max([y - least * x for x, y in below]),
        most_ns=min([y - most * x for x, y in above]),
        least_rate=least,
        most_rate=most,
    )
