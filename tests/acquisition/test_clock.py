"""The board's clock against a simulated one whose true offset, rate and delays are known."""

import math
import random

import pytest

from resonator_daemon.acquisition.clock import BoardClock, Exchange

REFERENCE_MILLIHERTZ = 250_000_000_000
UTC_LESS_MONOTONIC_NS = 1_789_000_000_000_000_000


class TrueBoard:
    """A board whose ticks are an exact function of the host's monotonic time."""

    def __init__(self, rate_ppm: float, ticks_at_zero: int = 10**15) -> None:
        self.hertz = REFERENCE_MILLIHERTZ / 1e3 * (1 - rate_ppm * 1e-6)
        self.ticks_at_zero = ticks_at_zero

    def ticks(self, monotonic_ns: float) -> int:
        return self.ticks_at_zero + int(monotonic_ns * self.hertz / 1e9)


def feed(
    clock: BoardClock,
    board: TrueBoard,
    pings: int,
    seed: int,
    period_ns: int = 40_000_000,
    start_ns: int = 5_000_000_000,
) -> int:
    """Exchange pings with random delays, one in ten 20 ms late on one way; return the time of the last."""
    rng = random.Random(seed)
    now = start_ns
    for _ in range(pings):
        there, back = rng.uniform(50e3, 150e3), rng.uniform(50e3, 150e3)
        if rng.random() < 0.1:
            back += 20e6
        exchange = Exchange(now, board.ticks(now + there), int(now + there + back))
        clock.add(exchange, UTC_LESS_MONOTONIC_NS)
        now += period_ns
    return now


@pytest.mark.parametrize("rate_ppm", [-50.0, 0.0, 50.0])
@pytest.mark.parametrize("seed", range(5))
def test_error_is_within_its_stated_uncertainty_and_small(rate_ppm: float, seed: int) -> None:
    board = TrueBoard(rate_ppm)
    clock = BoardClock(REFERENCE_MILLIHERTZ)
    now = feed(clock, board, pings=16 + 30, seed=seed)
    for ahead_ns in (-500_000_000, 0, 500_000_000, 1_000_000_000):
        instant = clock.at(board.ticks(now + ahead_ns))
        error_ns = instant.utc_ns - (now + ahead_ns + UTC_LESS_MONOTONIC_NS)
        assert abs(error_ns) <= instant.uncertainty_ns
        assert abs(error_ns) <= 200_000
        assert instant.uncertainty_ns <= 1_000_000
    assert math.isnan(clock.rate_ppm)  # two seconds of it do not tell the rate to 10 ppm
    feed(clock, board, pings=60, seed=seed, period_ns=1_000_000_000, start_ns=now)
    assert clock.rate_ppm == pytest.approx(rate_ppm, abs=10)


def test_one_exchange_is_enough_for_a_bound() -> None:
    board = TrueBoard(80.0)
    clock = BoardClock(REFERENCE_MILLIHERTZ)
    clock.add(Exchange(0, board.ticks(1_000_000), 1_100_000), 0)
    instant = clock.at(board.ticks(1_001_000_000))
    assert abs(instant.utc_ns - 1_001_000_000) <= instant.uncertainty_ns <= 700_000


def test_uncertainty_grows_with_distance() -> None:
    board = TrueBoard(10.0)
    clock = BoardClock(REFERENCE_MILLIHERTZ)
    now = feed(clock, board, 46, seed=1)
    near, far = (clock.at(board.ticks(now + ahead)).uncertainty_ns for ahead in (0, 10_000_000_000))
    assert far > near


def test_ticks_need_64_bits_and_lose_none() -> None:
    clock = BoardClock(1_000_000_000_000)  # 1 ns
    start = 2**63
    clock.add(Exchange(0, start, 0), 0)
    assert clock.at(start + 3).utc_ns == 3
    assert clock.at(start - 10**15).utc_ns == -(10**15)


def test_an_unknown_clock_is_not_guessed() -> None:
    clock = BoardClock(REFERENCE_MILLIHERTZ)
    assert not clock.known
    with pytest.raises(ValueError, match="not known before the first ping"):
        clock.at(1)
