"""What waits for the socket: the newest, bounded by count and by bytes; and what passes at a lower rate."""

from collections import deque
from collections.abc import Iterator
from typing import Final, Generic, Protocol, TypeVar

_NS_PER_S: Final = 1e9


class _Sized(Protocol):
    @property
    def size_bytes(self) -> int: ...


ItemT = TypeVar("ItemT", bound=_Sized)


class BoundedQueue(Generic[ItemT]):
    """First in, first out; what would exceed the bounds pushes the oldest out, and is itself always taken."""

    def __init__(self, count_max: int, bytes_max: int) -> None:
        self._count_max = count_max
        self._bytes_max = bytes_max
        self._items: deque[ItemT] = deque()
        self.size_bytes = 0

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[ItemT]:
        return iter(self._items)

    def put(self, item: ItemT) -> list[ItemT]:
        """Append an item; return those that had to go for it, the oldest first."""
        pushed_out = []
        while self._items and (
            len(self._items) >= self._count_max or self.size_bytes + item.size_bytes > self._bytes_max
        ):
            pushed_out.append(self.pop())
        self._items.append(item)
        self.size_bytes += item.size_bytes
        return pushed_out

    def pop(self) -> ItemT:
        item = self._items.popleft()
        self.size_bytes -= item.size_bytes
        return item

    def clear(self) -> list[ItemT]:
        items = list(self._items)
        self._items.clear()
        self.size_bytes = 0
        return items


class Decimator:
    """Lets the first message of each period pass, by the messages' own time.

    Periods are cut at multiples of their length, so that messages of a steady rate pass at a steady rate, too,
    whatever their times scatter by.

    Raises
    ------
    ValueError
        The rate is not above 0.
    """

    def __init__(self, rate_hz: float) -> None:
        if not rate_hz > 0.0:
            raise ValueError(f"rate {rate_hz!r} Hz: must be above 0")
        self._period_ns = max(round(_NS_PER_S / rate_hz), 1)
        self._last: int | None = None

    def lets_pass(self, t_ns: int) -> bool:
        period = t_ns // self._period_ns
        if self._last is not None and self._last - 1 <= period <= self._last:  # earlier still: the clock was set back
            return False
        self._last = period
        return True
