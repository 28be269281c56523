"""Queue between the reader thread and its consumer: bounded in bytes, what does not fit is counted."""

from collections import deque
from collections.abc import Callable, Sequence
from threading import Lock

from resonator_daemon.board.session.counters import FrameLoss
from resonator_daemon.board.session.frames import Arrival, Frame, Gap


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
    newest
        The frame that was appended last.
    """

    def __init__(self, limit_bytes: int, wake: Callable[[], None], step_frames: Sequence[int] = (1,)) -> None:
        self._limit_bytes = limit_bytes
        self._wake = wake
        self.step_frames = step_frames
        self._lock = Lock()
        self._ahead: list[Arrival] = []  # events and gaps, from when no frame before those in `_items` is left
        self._items: deque[tuple[int, Arrival]] = deque()
        self._bytes = 0
        self._overflow = 0
        self.newest: Frame | None = None

    def put(self, event: Arrival) -> None:
        """Append what is no frame."""
        with self._lock:
            self._items.append((0, event))
        self._wake()

    def put_frames(self, frames: Sequence[Frame]) -> None:
        """Append adjacent frames, one or more; when they complete a step, the consumer is woken."""
        size_bytes = frames[0].memory_bytes  # all of one board are of one size
        self.newest = frames[-1]
        with self._lock:
            self._items.extend([(size_bytes, frame) for frame in frames])
            self._bytes += size_bytes * len(frames)
            if self._bytes > self._limit_bytes:
                self._make_room()
        first, end = frames[0].index, frames[-1].index + 1
        for step in self.step_frames:
            if end // step > first // step:
                self._wake()
                break

    def pop_all(self) -> list[Arrival]:
        """Return and remove all that is there."""
        with self._lock:
            if not self._items and not self._ahead:
                return []
            ahead, self._ahead = self._ahead, []
            items, self._items = self._items, deque()
            self._bytes = 0
        return [*ahead, *[arrival for _, arrival in items]]

    @property
    def loss(self) -> FrameLoss:
        """Frames that gave way since the start."""
        with self._lock:
            return FrameLoss(queue_overflow=self._overflow)

    def _make_room(self) -> None:
        ahead = self._ahead
        while self._bytes > self._limit_bytes:
            size_bytes, arrival = self._items.popleft()
            if isinstance(arrival, Frame):
                self._bytes -= size_bytes
                self._overflow += 1
                arrival = Gap(arrival.index, FrameLoss(queue_overflow=1))
            if isinstance(arrival, Gap) and ahead and isinstance(ahead[-1], Gap) and _adjoin(ahead[-1], arrival):
                ahead[-1] = Gap(ahead[-1].first_index, ahead[-1].loss + arrival.loss)
            else:
                ahead.append(arrival)


def _adjoin(gap: Gap, later: Gap) -> bool:
    return gap.first_index + gap.loss.total == later.first_index
