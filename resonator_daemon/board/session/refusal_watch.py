"""Most frequent refusal of packets within the last second, for the state of the link."""

from collections.abc import Mapping
from typing import Final

from firmware_protocol.host import PacketRefusal

_SECOND_NS: Final = 1_000_000_000


class RefusalWatch:
    """Most frequent refusal within the last second.

    Parameters
    ----------
    counts
        Number of refused packets by reason, which grow.
    now_ns
        Monotonic time.
    """

    def __init__(self, counts: Mapping[PacketRefusal, int], now_ns: int) -> None:
        self._counts = counts
        self._before: Mapping[PacketRefusal, int] = {}
        self._since_ns = now_ns
        self._last_second: PacketRefusal | None = None

    def update(self, now_ns: int) -> bool:
        """Begin a new second if one is over; return whether the most frequent refusal may have changed."""
        if now_ns - self._since_ns < _SECOND_NS:
            return False
        before, self._last_second = self._last_second, self._most_of_this_second()
        self._before, self._since_ns = dict(self._counts), now_ns
        return before != self._last_second

    @property
    def most_frequent(self) -> PacketRefusal | None:
        """That of the last whole second, else of the present one; None if there is none."""
        return self._last_second or self._most_of_this_second()

    def _most_of_this_second(self) -> PacketRefusal | None:
        added = {refusal: count - self._before.get(refusal, 0) for refusal, count in self._counts.items()}
        most = max(added, key=added.__getitem__, default=None)
        return most if most is not None and added[most] else None
