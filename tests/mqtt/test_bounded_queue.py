"""The bounds of what waits, and rates by the messages' own time."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from resonator_daemon.mqtt.bounded_queue import BoundedQueue, Decimator

MS_NS = 1_000_000


class Item:
    def __init__(self, size_bytes: int) -> None:
        self.size_bytes = size_bytes


@given(st.lists(st.integers(0, 12), max_size=60), st.integers(1, 5), st.integers(1, 20))
def test_the_newest_that_fit_are_kept_in_order_and_nothing_gets_lost(sizes, count_max: int, bytes_max: int) -> None:
    queue: BoundedQueue[Item] = BoundedQueue(count_max, bytes_max)
    items = [Item(size) for size in sizes]
    pushed_out = []
    for item in items:
        pushed_out += queue.put(item)
        assert len(queue) <= count_max
        assert queue.size_bytes <= bytes_max or len(queue) == 1
    kept = [queue.pop() for _ in range(len(queue))]
    assert pushed_out + kept == items
    assert queue.size_bytes == 0
    if kept and pushed_out and len(kept) < count_max:
        assert sum(item.size_bytes for item in kept) + pushed_out[-1].size_bytes > bytes_max


@pytest.mark.parametrize(("source_hz", "rate_hz", "passed"), [(200, 20, 20), (100, 5, 5), (75, 20, 20), (10, 20, 10)])
def test_a_steady_rate_passes_at_the_rate_asked_for(source_hz: int, rate_hz: int, passed: int) -> None:
    chance = random.Random(3)
    decimator = Decimator(rate_hz)
    start_ns = 1_789_000_000_003_000_000
    count = 0
    for number in range(10 * source_hz):
        scatter_ns = chance.randrange(-MS_NS, MS_NS)
        count += decimator.lets_pass(start_ns + number * 1_000_000_000 // source_hz + scatter_ns)
    assert abs(count - 10 * passed) <= 1


def test_a_clock_that_is_set_back_silences_nothing() -> None:
    decimator = Decimator(20.0)
    assert decimator.lets_pass(10**18)
    assert not decimator.lets_pass(10**18 - 10 * MS_NS)  # late by one period: it had its turn
    assert decimator.lets_pass(10**18 - 3_600_000 * MS_NS)
