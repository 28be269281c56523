"""The board's clock against a simulated one whose true offset, rate and delays are known."""

import itertools
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import pytest

from resonator_daemon.board.session.clock import BoardClock, Exchange, Instant

NS = 1_000_000_000
REFERENCE_MILLIHERTZ = 250_000_000_000
UTC_LESS_MONOTONIC_NS = 1_789_000_000_000_000_000
_CREDIT_PINGS = 2  # unanswered; 64 bytes hold no more
_LOOK_NS = 20_000_000
_LOOK_BACK_NS = 5_000_000

Delay = Callable[[random.Random, float], float]  # from the time in ns at which it starts


@dataclass(frozen=True)
class Crystal:
    """Ticks as a function of the host's monotonic time, slower than nominal by `ppm` and a sine of `swing_ppm`."""

    ppm: float = 0.0
    swing_ppm: float = 0.0
    swing_ppm_per_s: float = 0.5  # steepest change
    ticks_at_zero: int = 10**15
    reference_millihertz: int = REFERENCE_MILLIHERTZ

    def rate_ppm(self, monotonic_ns: int) -> float:
        return self.ppm + self.swing_ppm * math.sin(self._turn(monotonic_ns))

    def ticks(self, monotonic_ns: int) -> int:
        slower_ns = round(monotonic_ns * self.ppm * 1e-6)
        if self.swing_ppm:
            amplitude_ns = 1e3 * self.swing_ppm**2 / self.swing_ppm_per_s
            slower_ns += round(amplitude_ns * (1 - math.cos(self._turn(monotonic_ns))))
        return self.ticks_at_zero + (monotonic_ns - slower_ns) * self.reference_millihertz // 10**12

    def _turn(self, monotonic_ns: int) -> float:
        return monotonic_ns / NS * self.swing_ppm_per_s / self.swing_ppm if self.swing_ppm else 0.0


def between(least_us: float, most_us: float) -> Delay:
    return lambda rng, _: rng.uniform(least_us, most_us) * 1e3


def clumped(period_ms: float) -> Delay:
    """Return answers collected on a grid, as a USB serial adapter does."""
    period_ns, way = period_ms * 1e6, between(20, 80)
    return lambda rng, at: math.ceil((at + way(rng, at)) / period_ns) * period_ns - at + way(rng, at)


def sometimes(delay: Delay, share: float, least_us: float, most_us: float) -> Delay:
    """Return a delay to which now and then another is added."""
    return lambda rng, at: delay(rng, at) + (rng.uniform(least_us, most_us) * 1e3 if rng.random() < share else 0.0)


def busy_host(delay: Delay) -> Delay:
    """Return a delay with the pauses of a scheduler: one in twenty, 0.1 to 2 ms."""
    return sometimes(delay, 0.05, 100.0, 2000.0)


@dataclass(frozen=True)
class Scene:
    """A crystal, and the delays to the board and back."""

    name: str
    crystal: Crystal
    there: Delay
    back: Delay


class Look(NamedTuple):
    """Estimate of the clock for a tick count, with its error."""

    monotonic_ns: int
    error_ns: int
    estimate: Instant


def play(
    scene: Scene, seed: int, seconds: float, *, clock: BoardClock | None = None, start_ns: int = 5 * NS
) -> Iterator[Look]:
    """Exchange pings as the clock paces them; look 50 times a second at a tick count 5 ms old."""
    rng = random.Random(seed)
    clock = clock or BoardClock(scene.crystal.reference_millihertz)
    end_ns = start_ns + round(seconds * NS)
    due_ns, look_ns, at_board_ns, answered_ns = start_ns, start_ns + _LOOK_BACK_NS, 0, 0
    answers: list[Exchange] = []
    while True:
        now = min(due_ns, look_ns, answers[0].received_monotonic_ns if answers else due_ns)
        if now > end_ns:
            return
        if answers and answers[0].received_monotonic_ns == now:
            clock.add(answers.pop(0), UTC_LESS_MONOTONIC_NS)
            due_ns = min(due_ns, clock.ping_due_ns(now))
        elif now == due_ns:
            if len(answers) < _CREDIT_PINGS:  # streams, both ways: none overtakes
                at_board_ns = max(at_board_ns, now + round(scene.there(rng, now)))
                answered_ns = max(answered_ns, at_board_ns + round(scene.back(rng, at_board_ns)))
                answers.append(Exchange(now, scene.crystal.ticks(at_board_ns), answered_ns))
            due_ns = clock.ping_due_ns(now)
        else:
            look_ns += _LOOK_NS
            if clock.snapshot() is not None:
                then = now - _LOOK_BACK_NS
                estimate = clock.scale.at(scene.crystal.ticks(then))
                yield Look(then, estimate.monotonic_ns - then, estimate)


def scenes(ppm: float = 50.0) -> list[Scene]:
    """Return the links of the table."""
    crystal, warming = Crystal(ppm), Crystal(ppm, swing_ppm=20.0)
    grid = busy_host(sometimes(clumped(16.0), 0.01, 50e3, 50e3))
    return [
        Scene("plain, 100-300 us", crystal, QUICK, QUICK),
        Scene("plain, crystal warming", warming, QUICK, QUICK),
        Scene("busy host", crystal, busy_host(QUICK), busy_host(QUICK)),
        Scene("16 ms batches, late, busy", crystal, busy_host(QUICK), grid),
        Scene("the same, crystal warming", warming, busy_host(QUICK), grid),
        Scene("1 ms batches", warming, QUICK, clumped(1.0)),
        Scene("asymmetric, 0.1 and 2 ms", warming, QUICK, between(2000, 2100)),
        Scene("slow serial, 2 ms each way", warming, between(1950, 2050), between(1950, 2050)),
    ]


CLUMPS = "16 ms batches, late, busy"
CLUMPS_WARMING = "the same, crystal warming"
QUICK = between(50, 150)


def scene(name: str, ppm: float = 50.0) -> Scene:
    return next(it for it in scenes(ppm) if it.name == name)


def rms_ns(looks: list[Look]) -> float:
    return math.sqrt(sum(look.error_ns**2 for look in looks) / len(looks))


def honest(look: Look) -> bool:
    return abs(look.error_ns) <= look.estimate.uncertainty_ns


def trip(
    crystal: Crystal, sent_ns: int, there_ns: int = 80_000, back_ns: int = 90_000, *, jump_ticks: int = 0
) -> Exchange:
    at_board_ns = sent_ns + there_ns
    return Exchange(sent_ns, crystal.ticks(at_board_ns) + jump_ticks, at_board_ns + back_ns)


def settled(crystal: Crystal, seconds: float = 10.0) -> tuple[BoardClock, int]:
    """Return a clock over a quick link, and the time."""
    clock = BoardClock(crystal.reference_millihertz)
    for _ in play(Scene("", crystal, QUICK, QUICK), 1, seconds, clock=clock):
        pass
    return clock, 5 * NS + round(seconds * NS)


@pytest.mark.parametrize("ppm", [-50.0, 0.0, 50.0])
@pytest.mark.parametrize("name", [CLUMPS, CLUMPS_WARMING])
def test_clumped_and_late_answers_leave_200_us_five_seconds_after_connecting(name: str, ppm: float) -> None:
    looks = [look for seed in range(4) for look in play(scene(name, ppm), seed, 20.0)]
    late = [look for look in looks if look.monotonic_ns >= 10 * NS]
    assert rms_ns(late) <= 200_000
    assert rms_ns([look for look in late if look.monotonic_ns <= 11 * NS]) <= 200_000
    assert all(map(honest, looks))
    assert sorted(look.estimate.uncertainty_ns for look in late)[len(late) // 2] <= 200_000


@pytest.mark.parametrize("name", [it.name for it in scenes()])
def test_error_is_within_its_stated_uncertainty_on_every_link(name: str) -> None:
    looks = list(play(scene(name, -50.0), 7, 20.0))
    assert len(looks) > 900
    assert all(map(honest, looks))


@pytest.mark.parametrize("name", ["plain, 100-300 us", "plain, crystal warming", "busy host"])
def test_quick_link_is_known_to_100_us_and_right_to_30(name: str) -> None:
    late = [look for look in play(scene(name), 3, 60.0) if look.monotonic_ns >= 13 * NS]
    assert max(look.estimate.uncertainty_ns for look in late) <= 130_000
    assert sorted(look.estimate.uncertainty_ns for look in late)[len(late) // 2] <= 100_000
    assert rms_ns(late) <= 30_000


@pytest.mark.parametrize("ppm", [-190.0, -50.0, 50.0, 190.0])
def test_rate_is_told_once_it_is_known(ppm: float) -> None:
    crystal = Crystal(ppm)
    clock, _ = settled(crystal, 0.5)
    assert math.isnan(clock.rate_ppm)
    clock, _ = settled(crystal, 60.0)
    assert clock.rate_ppm == pytest.approx(ppm, abs=5)
    assert clock.rate_beyond_tolerance is None


@pytest.mark.parametrize("name", [it.name for it in scenes()])
@pytest.mark.parametrize("ppm", [-170.0, 170.0, 700.0])
def test_crystal_within_tolerance_is_never_accused(name: str, ppm: float) -> None:
    clock = BoardClock(REFERENCE_MILLIHERTZ)
    for _ in play(scene(name, ppm), 2, 10.0, clock=clock):
        assert clock.rate_beyond_tolerance is None


@pytest.mark.parametrize("ppm", [-1200.0, 1200.0, 5000.0, -5000.0, 50_000.0, -50_000.0, 500_000.0])
@pytest.mark.parametrize("name", ["plain, 100-300 us", CLUMPS])
def test_board_that_lies_about_its_reference_is_measured(name: str, ppm: float) -> None:
    clock = BoardClock(REFERENCE_MILLIHERTZ)
    for _ in play(scene(name, ppm), 1, 20.0, clock=clock):
        pass
    measured_ppm, uncertainty_ppm = clock.rate_beyond_tolerance
    true_ppm = 1e6 * (1 / (1 - ppm * 1e-6) - 1)  # host time per board time
    assert abs(measured_ppm - true_ppm) <= uncertainty_ppm <= 30


@pytest.mark.parametrize("jump_ns", [-3_000_000, 3_000_000, 10**15])
def test_single_contradiction_is_set_aside_and_doubted_until_the_next(jump_ns: int) -> None:
    crystal = Crystal(10.0)
    clock, now = settled(crystal)
    jump_ticks = jump_ns // 4
    clock.add(trip(crystal, now, jump_ticks=jump_ticks), UTC_LESS_MONOTONIC_NS)
    doubted = clock.scale.at(crystal.ticks(now))
    assert abs(doubted.monotonic_ns - now) < 100_000
    assert abs(jump_ns) < doubted.uncertainty_ns < abs(jump_ns) * 1.001 + 400_000
    assert clock.ping_due_ns(now) - now < 30_000_000
    clock.add(trip(crystal, now + NS), UTC_LESS_MONOTONIC_NS)
    assert clock.scale.at(crystal.ticks(now)).uncertainty_ns < 150_000
    assert (clock.outliers, clock.restarts) == (1, 0)


@pytest.mark.parametrize("jump_ns", [-2 * NS, -5_000_000, 5_000_000, 3600 * NS])
def test_step_of_the_boards_ticks_restarts_and_is_covered_from_the_first_sign(jump_ns: int) -> None:
    crystal = Crystal(10.0)
    clock, now = settled(crystal)
    jump_ticks = jump_ns // 4
    for number in range(100):
        sent = now + number * 20_000_000
        clock.add(trip(crystal, sent, jump_ticks=jump_ticks), UTC_LESS_MONOTONIC_NS)
        instant = clock.scale.at(crystal.ticks(sent) + jump_ticks)
        assert abs(instant.monotonic_ns - sent) <= instant.uncertainty_ns
    assert (clock.outliers, clock.restarts) == (3, 1)
    assert instant.uncertainty_ns < 150_000
    assert clock.rate_beyond_tolerance is None


def test_answer_before_its_question_is_set_aside() -> None:
    crystal = Crystal(10.0)
    clock, now = settled(crystal)
    before = clock.scale.at(crystal.ticks(now))
    clock.add(Exchange(now, crystal.ticks(now), now - 1), UTC_LESS_MONOTONIC_NS)
    assert clock.scale.at(crystal.ticks(now)) == before
    assert clock.outliers == 1
    fresh = BoardClock(REFERENCE_MILLIHERTZ)
    fresh.add(Exchange(5, 7, 4), 0)
    with pytest.raises(ValueError, match="not known"):
        fresh.scale.at(7)


@pytest.mark.parametrize("step_ns", [-3600 * NS, 3600 * NS])
def test_step_of_the_wall_clock_moves_utc_once_and_no_sample(step_ns: int) -> None:
    crystal = Crystal(30.0)
    clock, now = settled(crystal)
    ticks = crystal.ticks(now)
    exchange = trip(crystal, now)
    clock.add(exchange, UTC_LESS_MONOTONIC_NS)
    before = clock.scale.at(ticks)
    clock.add(exchange, UTC_LESS_MONOTONIC_NS + step_ns)
    after = clock.scale.at(ticks)
    assert after.utc_ns - before.utc_ns == step_ns
    assert after._replace(utc_ns=before.utc_ns) == before
    assert (clock.outliers, clock.restarts) == (0, 0)


@pytest.mark.parametrize("fell_asleep", ["before the ping", "on the way there", "on the way back"])
def test_host_that_slept_knows_the_time_again_at_the_first_ping_and_well_at_the_second(fell_asleep: str) -> None:
    crystal, slept_ns = Crystal(30.0), 3600 * NS
    clock, now = settled(crystal)
    slept_ticks = slept_ns // 4
    old = clock.scale.at(crystal.ticks(now))
    jump_ticks = 0 if fell_asleep == "on the way back" else slept_ticks
    clock.add(
        trip(crystal, now, jump_ticks=jump_ticks), UTC_LESS_MONOTONIC_NS + slept_ns, boottime_less_monotonic_ns=slept_ns
    )
    assert abs(old.monotonic_ns - now) < 100_000
    first = clock.scale.at(crystal.ticks(now) + slept_ticks)
    assert abs(first.monotonic_ns - now) <= first.uncertainty_ns
    assert clock.restarts == 1
    later = now + 20_000_000
    clock.add(
        trip(crystal, later, jump_ticks=slept_ticks),
        UTC_LESS_MONOTONIC_NS + slept_ns,
        boottime_less_monotonic_ns=slept_ns,
    )
    second = clock.scale.at(crystal.ticks(later) + slept_ticks)
    assert abs(second.monotonic_ns - later) <= second.uncertainty_ns < 200_000
    assert second.utc_ns == second.monotonic_ns + UTC_LESS_MONOTONIC_NS + slept_ns
    assert (clock.outliers, clock.restarts) == (0, 1)


def test_thirty_days_lose_no_nanosecond() -> None:
    month_ns, millihertz = 30 * 86400 * NS, 999_999_937_000
    crystal = Crystal(ticks_at_zero=2**63, reference_millihertz=millihertz)
    clock = BoardClock(millihertz)
    for sent in itertools.chain(range(0, NS, NS // 10), range(month_ns, month_ns + 60 * NS, NS // 2)):
        clock.add(trip(crystal, sent, 1000, 1000), UTC_LESS_MONOTONIC_NS)
    newest = month_ns + 60 * NS
    ticks = crystal.ticks(newest)
    times = [clock.scale.at(ticks + number) for number in range(1000)]
    assert abs(times[0].monotonic_ns - newest) <= 20
    spacings = {(b.monotonic_ns - a.monotonic_ns, b.utc_ns - a.utc_ns) for a, b in itertools.pairwise(times)}
    assert spacings <= {(1, 1), (2, 2)}
    assert (clock.outliers, clock.restarts) == (0, 0)
