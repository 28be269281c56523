"""The ring between the reader thread and everything behind it: bounded in bytes, and what does not fit is counted."""

from collections import deque
from collections.abc import Callable
from threading import Lock

from resonator_daemon.acquisition.frames import Arrival, ChannelisedFrame, FrameLoss, SingleToneFrame


class Ring:
    """Arrivals in order; when frames take more than `limit_bytes`, the oldest frames give way, news never.

    Parameters
    ----------
    limit_bytes
        Bound, in bytes on the wire, of the frames kept.
    wake
        Called, from the writing thread, when something was put into an empty ring.
    """

    def __init__(self, limit_bytes: int, wake: Callable[[], None]) -> None:
        self._limit_bytes = limit_bytes
        self._wake = wake
        self._lock = Lock()
        self._items: deque[tuple[int, Arrival]] = deque()
        self._bytes = 0
        self._overrun = 0

    def put(self, arrival: Arrival, size_bytes: int = 0) -> None:
        """Append one arrival; `size_bytes` is a frame's size on the wire, 0 for news."""
        with self._lock:
            was_empty = not self._items
            self._items.append((size_bytes, arrival))
            self._bytes += size_bytes
            if self._bytes > self._limit_bytes:
                self._make_room()
        if was_empty:
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
            if isinstance(arrival, SingleToneFrame | ChannelisedFrame):
                self._bytes -= size_bytes
                self._overrun += 1
            else:
                news.append((size_bytes, arrival))
        self._items.extendleft(reversed(news))
