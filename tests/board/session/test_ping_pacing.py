"""When pings leave."""

import itertools

import pytest

from resonator_daemon.board.session.clock import PingPacing

MS, S = 1_000_000, 1_000_000_000


def leaving_times(pacing: PingPacing, count: int, start_ns: int = 12_345_678_901) -> list[int]:
    return list(itertools.accumulate(range(count), lambda now, _: pacing.next_ns(now), initial=start_ns))


def calm() -> PingPacing:
    pacing = PingPacing()
    pacing.update(0, 50_000.0, 20)
    return pacing


@pytest.mark.parametrize("grid_ms", [1, 5, 10, 16])
@pytest.mark.parametrize("pacing", [PingPacing(), calm()], ids=["rapid", "calm"])
def test_pings_fall_evenly_on_every_grid(pacing: PingPacing, grid_ms: int) -> None:
    eighths = [0] * 8
    for time_ns in leaving_times(pacing, 1000):
        eighths[time_ns % (grid_ms * MS) * 8 // (grid_ms * MS)] += 1
    assert min(eighths) > 85
    assert max(eighths) < 165


def test_it_begins_at_a_hundred_a_second_and_calms_down_to_one() -> None:
    for pacing, mean_ns, span_ns in ((PingPacing(), 10 * MS, 9 * MS), (calm(), 970 * MS, 9 * MS)):
        times = leaving_times(pacing, 1000)
        periods = [b - a for a, b in itertools.pairwise(times)]
        assert sum(periods) / len(periods) == pytest.approx(mean_ns, rel=0.02)
        assert all(abs(period - mean_ns) <= span_ns for period in periods)


def rapid(pacing: PingPacing) -> bool:
    return pacing.next_ns(0) < 100 * MS


@pytest.mark.parametrize(
    "steps",
    [
        [(1, 101_000.0, True), (2, 99_000.0, False)],
        [(25, 2e6, True), (31, 2e6, True), (62, 2e6, False)],  # the best value of the link is discarded after 30 s
    ],
)
def test_pings_are_rapid_above_100_us_and_after_the_best_value_expires(steps: list[tuple[int, float, bool]]) -> None:
    pacing = calm()
    assert not rapid(pacing)
    for at_s, uncertainty_ns, expected in steps:
        pacing.update(at_s * S, uncertainty_ns, 1000)
        assert rapid(pacing) is expected


def test_what_a_link_cannot_do_is_not_asked_of_it() -> None:
    pacing = PingPacing()
    for number in range(1, 1000):
        pacing.update(number * 10 * MS, 2e6, number)
        assert rapid(pacing) == (number < 800)
    pacing.update(11 * S, 2.5e6, 1000)  # but what it could a moment ago
    assert rapid(pacing)
