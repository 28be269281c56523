"""Queue between the reader thread and its consumer: bounded in bytes, what does not fit is counted."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from threading import Lock

from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frames import Arrival, ChannelisedFrame, Frame, FrameLoss, Gap, SingleToneFrame


class FrameQueue:
    """Arrivals in order; when frames take more than `limit_bytes`, the oldest give way to a gap; events are kept.

    Parameters
    ----------
    limit_bytes
        Bound of the memory that the frames kept take.
    wake
        Called, from the writing thread, when an event was put in, or a frame that completes a step.
    step_frames
        Frames that are of no use one by one: those whose index, counted from 1, is a multiple of any of these numbers
        complete a step. It may be replaced at any time.

    Attributes
    ----------
    newest_index, newest_middle_ns
        Of the frame that was appended last: its index, and the middle of its gate on the monotonic clock; -1 and 0
        before the first.
    """

    def __init__(self, limit_bytes: int, wake: Callable[[], None], step_frames: Sequence[int] = (1,)) -> None:
        self._limit_bytes = limit_bytes
        self._wake = wake
        self.step_frames = step_frames
        self._lock = Lock()
        self._ahead: list[Arrival] = []  # events and gaps, from when no frame before those in `_items` is left
        self._items: deque[Arrival] = deque()
        self._frames = 0  # in `_items`; all of one board are of one size
        self._overflow = 0
        self.newest_index = -1
        self.newest_middle_ns = 0

    def put(self, event: Arrival) -> None:
        """Append what is no frame."""
        with self._lock:
            self._items.append(event)
        self._wake()

    def put_frames(self, frames: Sequence[Frame], newest: Instant) -> None:
        """Append adjacent frames, the last with this middle; when they complete a step, the consumer is woken."""
        with self._lock:
            self._items.extend(frames)
            self._frames += len(frames)
            size_bytes = frames[0].memory_bytes
            if self._frames * size_bytes > self._limit_bytes:
                self._make_room(self._limit_bytes // size_bytes)
        first, end = frames[0].index, frames[-1].index + 1
        self.newest_index, self.newest_middle_ns = end - 1, newest.monotonic_ns
        for step in self.step_frames:
            if end // step > first // step:
                self._wake()
                break

    def pop_all(self) -> list[Arrival]:
        """Return and remove all that is there."""
        with self._lock:
            arrivals = [*self._ahead, *self._items]
            self._ahead.clear()
            self._items.clear()
            self._frames = 0
        return arrivals

    @property
    def loss(self) -> FrameLoss:
        """Frames that gave way since the start."""
        with self._lock:
            return FrameLoss(queue_overflow=self._overflow)

    def _make_room(self, frames_max: int) -> None:
        ahead = self._ahead
        while self._frames > frames_max:
            arrival = self._items.popleft()
            if isinstance(arrival, Frame):
                self._frames -= 1
                self._overflow += 1
                arrival = Gap(arrival.index, FrameLoss(queue_overflow=1))
            if isinstance(arrival, Gap) and ahead and isinstance(ahead[-1], Gap) and _adjoin(ahead[-1], arrival):
                ahead[-1] = Gap(ahead[-1].first_index, ahead[-1].loss + arrival.loss)
            else:
                ahead.append(arrival)


def _adjoin(gap: Gap, later: Gap) -> bool:
    return gap.first_index + gap.loss.total == later.first_index


def group_adjacent(arrivals: Iterable[Arrival], most: int) -> list[Arrival | list[Frame]]:
    """Return arrivals in their order, adjacent frames together, up to `most` of them."""
    groups: list[Arrival | list[Frame]] = []
    block: list[Frame] = []
    for arrival in arrivals:
        if not isinstance(arrival, SingleToneFrame | ChannelisedFrame):
            groups.append(arrival)
            block = []
        elif block and len(block) < most and arrival.index == block[-1].index + 1:
            block.append(arrival)
        else:
            block = [arrival]
            groups.append(block)
    return groups
