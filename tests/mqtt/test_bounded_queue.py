"""The bounds of what waits."""

from hypothesis import given
from hypothesis import strategies as st

from resonator_daemon.mqtt.outbox import BoundedQueue


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
        assert len(queue.items) <= count_max
        assert queue.size_bytes <= bytes_max or len(queue.items) == 1
    kept = queue.pop(count_max)
    assert pushed_out + kept == items
    assert queue.size_bytes == 0
    if kept and pushed_out and len(kept) < count_max:
        assert sum(item.size_bytes for item in kept) + pushed_out[-1].size_bytes > bytes_max
