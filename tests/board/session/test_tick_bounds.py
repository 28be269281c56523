"""Hulls of bounds against all of the bounds they stand for."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from resonator_daemon.board.session.tick_bounds import TickBounds

MS, S = 1_000_000, 1_000_000_000
RATES = (-0.01, 0.01)


def wander_ns(age_ns: int) -> Fraction:
    """What 0.5 ppm a second leave a line by."""
    return Fraction(age_ns**2, 4 * 10**15)


def all_rates(bounds: list[tuple[int, int, int]]) -> tuple[Fraction, Fraction]:
    """Return least and most rate from every pair of bounds, loosened by their age."""
    least, most = Fraction(RATES[0]), Fraction(RATES[1])
    now = bounds[-1][0]
    for below_at, floor, _ in bounds:
        for above_at, _, ceiling in bounds:
            room = ceiling - floor + wander_ns(now - below_at) + wander_ns(now - above_at)
            if above_at > below_at:
                most = min(most, room / (above_at - below_at))
            elif above_at < below_at:
                least = max(least, room / (above_at - below_at))
    return least, most


steps = st.lists(st.tuples(st.integers(1, 6 * S), st.integers(0, 300_000), st.integers(0, 300_000)), max_size=15)


@given(steps)
def test_what_the_hull_drops_would_not_have_bound(trips: list[tuple[int, int, int]]) -> None:
    bounds = [(0, -100, 100)]
    it = TickBounds(RATES, *bounds[0])
    for step_ns, there_ns, back_ns in trips:
        at_ns = bounds[-1][0] + step_ns
        bounds.append((at_ns, at_ns // 100_000 - there_ns - 1, at_ns // 100_000 + back_ns + 1))  # 10 ppm
        assert it.add(*bounds[-1])
    least, most = all_rates(bounds)
    lines = it.lines
    assert lines.least_rate == pytest.approx(float(least), abs=1e-12)
    assert lines.most_rate == pytest.approx(float(most), abs=1e-12)
    now = bounds[-1][0]
    lowest = max(low - wander_ns(now - at) + least * (now - at) for at, low, _ in bounds)
    highest = min(high + wander_ns(now - at) + most * (now - at) for at, _, high in bounds)
    assert lines.excess_ns + lines.least_ns == pytest.approx(float(lowest), abs=0.01)
    assert lines.excess_ns + lines.most_ns == pytest.approx(float(highest), abs=0.01)


def test_contradiction_changes_nothing() -> None:
    it = TickBounds(RATES, 0, 0, 100)
    assert it.add(S, 0, 100)
    before = it.lines
    assert not it.add(2 * S, 30 * MS, 30 * MS + 100)  # 30 000 ppm
    assert not it.add(2 * S, -30 * MS - 100, -30 * MS)
    assert not it.add(S - 1, 0, 100)  # ticks went back
    assert not it.add(S, 101, 200)  # the same tick count at another time
    assert not it.add(10**6 * S, -(10**6) * S, 100 - 10**6 * S)  # ticks far ahead of all
    assert not it.add(200 * S, 3 * S, 3 * S + 100)  # 15 000 ppm, over longer than bounds are kept
    assert (it.lines, it.count) == (before, 2)


def test_same_tick_twice_narrows_both_bounds() -> None:
    it = TickBounds(RATES, 0, 0, 100)
    assert it.add(0, 20, 150)
    assert it.add(0, 10, 70)
    assert (it.lines.excess_ns + it.lines.least_ns, it.lines.excess_ns + it.lines.most_ns) == (20, 70)


def test_narrowed_range_of_rates_narrows_the_excess() -> None:
    it = TickBounds(RATES, 0, 0, 1000)
    assert it.add(S, 0, 2 * MS)
    wide, narrow = it.lines, it.narrowed((-1e-6, 1e-6))
    assert narrow.most_rate == 1e-6
    assert narrow.most_ns - narrow.least_ns < 3000 < wide.most_ns - wide.least_ns
    assert it.narrowed((0.005, 0.01)) is None


@pytest.mark.parametrize("period_ns", [20 * MS, S, 10 * S])
def test_memory_is_short_and_goes_far_back_where_every_bound_stays_on_the_hull(period_ns: int) -> None:
    it = TickBounds(RATES, 0, -100, 100)
    for number in range(1, 1000):
        assert it.add(number * period_ns, -100, 100)
        bounds = it.snapshot()
        assert max(len(bounds.floor), len(bounds.ceiling)) <= 16
        oldest = min(bounds.floor[0].nominal_ns, bounds.ceiling[0].nominal_ns)
        assert min(number * period_ns, 100 * S) <= number * period_ns - oldest <= 128 * S
