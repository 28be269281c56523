"""The ring between the reader thread and everything behind it: bounded in bytes, and what does not fit is counted."""

from collections import deque
from collections.abc import Callable
from threading import Lock

from resonator_daemon.acquisition.frames import Arrival, ChannelisedFrame, FrameLoss, SingleToneFrame

FRAME = (SingleToneFrame, ChannelisedFrame)


class Ring:
    """Arrivals in order; when frames take more than `limit_bytes`, the oldest frames give way, news never.

    Parameters
    ----------
    limit_bytes
        Bound, in bytes on the wire, of the frames kept.
    wake
        Called, from the writing thread, when news was put in, or a frame that completes a step.
    step_frames
        Frames that are of no use one by one: those whose index, counted from 1, is a multiple of it complete a step.
    """

    def __init__(self, limit_bytes: int, wake: Callable[[], None], step_frames: int = 1) -> None:
        self._limit_bytes = limit_bytes
        self._wake = wake
        self._step_frames = step_frames
        self._lock = Lock()
        self._items: deque[tuple[int, Arrival]] = deque()
        self._bytes = 0
        self._overrun = 0

    def put(self, arrival: Arrival, size_bytes: int = 0) -> None:
        """Append one arrival; `size_bytes` is a frame's size on the wire, 0 for news."""
        with self._lock:
            self._items.append((size_bytes, arrival))
            self._bytes += size_bytes
            if self._bytes > self._limit_bytes:
                self._make_room()
        if not isinstance(arrival, FRAME) or (arrival.index + 1) % self._step_frames == 0:
            self._wake()

    def take(self) -> list[Arrival]:
        """Return and remove all that is there."""
        with self._lock:
            items, self._items = self._items, deque()
            self._bytes = 0
        return [arrival for _, arrival in items]

    @property
    def loss(self) -> FrameLoss:
        """Frames that gave way since the start."""
        with self._lock:
            return FrameLoss(host_overrun=self._overrun)

    def _make_room(self) -> None:
        news = []
        while self._bytes > self._limit_bytes:
            size_bytes, arrival = self._items.popleft()
            if isinstance(arrival, FRAME):
                self._bytes -= size_bytes
                self._overrun += 1
            else:
                news.append((size_bytes, arrival))
        self._items.extendleft(reversed(news))
