"""The frame queue: order, bound, what gives way, and when the reader's consumer is woken."""

import tracemalloc

import numpy as np
import pytest

from resonator_daemon.board.session.clock import Instant, Line, TickScale
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import TONE, BoardLogLine, ChannelisedFrame, FrameLoss, Gap, SingleToneFrame

SCALE = TickScale(10**12, 0, Line(0, 0, 0.0, 0.0, 0.0), 0, 0)
NOW = Instant(0, 0)
FRAME_BYTES = SingleToneFrame(0, 0, 0, SCALE, b"").memory_bytes


def frame(index: int) -> SingleToneFrame:
    return SingleToneFrame(index, index, index, SCALE, bytes(176))


def test_takes_in_order_and_wakes_for_news_and_whole_steps() -> None:
    wakes: list[int] = []
    index = 0
    queue = FrameQueue(100 * FRAME_BYTES, lambda: wakes.append(index + 1), step_frames=(2, 5))
    for index in range(10):
        queue.put_frames([frame(index)], NOW)
    assert wakes == [2, 4, 5, 6, 8, 10]
    queue.step_frames = (7,)
    for index in range(10, 30):
        queue.put_frames([frame(index)], NOW)
    assert wakes[6:] == [14, 21, 28]
    assert queue.pop_all() == [frame(index) for index in range(30)]
    assert queue.pop_all() == []
    queue.put(BoardLogLine(20, "news"))
    assert wakes[9:] == [30]
    queue.put_frames([frame(30)], NOW)
    assert queue.pop_all() == [BoardLogLine(20, "news"), frame(30)]


def test_when_full_the_oldest_frames_give_way_to_a_gap_and_news_stays() -> None:
    queue = FrameQueue(3 * FRAME_BYTES, lambda: None)
    news = [BoardLogLine(20, "first"), BoardLogLine(20, "second")]
    queue.put(news[0])
    queue.put_frames([frame(0)], NOW)
    queue.put(news[1])
    for index in range(1, 6):
        queue.put_frames([frame(index)], NOW)
    assert queue.loss == FrameLoss(queue_overflow=3)
    given_up = [Gap(0, FrameLoss(queue_overflow=1)), Gap(1, FrameLoss(queue_overflow=2))]
    assert queue.pop_all() == [news[0], given_up[0], news[1], given_up[1], frame(3), frame(4), frame(5)]
    queue.put_frames([frame(6)], NOW)
    assert queue.pop_all() == [frame(6)]
    assert queue.loss == FrameLoss(queue_overflow=3)


def test_gaps_that_adjoin_become_one() -> None:
    queue = FrameQueue(2 * FRAME_BYTES, lambda: None)
    queue.put_frames([frame(0)], NOW)
    queue.put(Gap(1, FrameLoss(damaged=4)))
    for index in range(5, 9):
        queue.put_frames([frame(index)], NOW)
    assert queue.pop_all() == [Gap(0, FrameLoss(damaged=4, queue_overflow=3)), frame(7), frame(8)]


def fresh_single_tone(index: int) -> SingleToneFrame:
    """Return a frame that shares no object with another, as those from the link."""
    big = 2**40 + index
    return SingleToneFrame(2**30 + index, big, big - 500_000, SCALE, bytes(176) + b"x"[:0])


def fresh_channelised(index: int) -> ChannelisedFrame:
    big = 2**40 + index
    return ChannelisedFrame(2**30 + index, big, Instant(big + 1, 2**31 + index, big + 2), np.zeros((4, 300), TONE))


@pytest.mark.parametrize("fresh", [fresh_single_tone, fresh_channelised])
def test_the_bound_is_one_of_memory(fresh: object) -> None:
    limit_bytes = 1_000_000
    queue = FrameQueue(limit_bytes, lambda: None)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for index in range(4000):
            queue.put_frames([fresh(index)], NOW)  # type: ignore[operator]
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert queue.loss.total > 0
    assert 0.7 * limit_bytes < after - before <= 1.05 * limit_bytes
