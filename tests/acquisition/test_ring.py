"""The ring: order, bound, what gives way, and when the reader's consumer is woken."""

from resonator_daemon.acquisition.clock import Instant
from resonator_daemon.acquisition.frames import BoardSays, FrameLoss, SingleToneFrame
from resonator_daemon.acquisition.ring import Ring


def frame(index: int) -> SingleToneFrame:
    return SingleToneFrame(index, index, Instant(0, 0), ())


def test_takes_in_order_and_wakes_for_news_and_whole_steps() -> None:
    wakes = []
    ring = Ring(1000, lambda: wakes.append(1), step_frames=3)
    for index in range(2):
        ring.put(frame(index), 100)
    assert wakes == []
    ring.put(frame(2), 100)
    assert len(wakes) == 1
    assert ring.take() == [frame(0), frame(1), frame(2)]
    assert ring.take() == []
    ring.put(BoardSays(20, "news"))
    assert len(wakes) == 2
    ring.put(frame(3), 100)
    assert len(wakes) == 2
    assert ring.take() == [BoardSays(20, "news"), frame(3)]


def test_when_full_the_oldest_frames_give_way_and_news_stays() -> None:
    ring = Ring(300, lambda: None)
    news = [BoardSays(20, "first"), BoardSays(20, "second")]
    ring.put(news[0])
    ring.put(frame(0), 100)
    ring.put(news[1])
    for index in range(1, 6):
        ring.put(frame(index), 100)
    assert ring.loss == FrameLoss(host_overrun=3)
    assert ring.take() == [*news, frame(3), frame(4), frame(5)]
    ring.put(frame(6), 100)
    assert ring.take() == [frame(6)]
    assert ring.loss == FrameLoss(host_overrun=3)
