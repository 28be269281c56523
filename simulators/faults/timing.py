"""When bytes arrive, and in which pieces: the line between the board's output and the link."""

import heapq
import math
from collections import deque
from typing import NamedTuple

import numpy as np

from simulators.faults.account import FaultCounts
from simulators.faults.plan import FaultPlan

_ALLOWANCE_S = 0.01  # of a slow reader's bytes that may come at once


class Lot(NamedTuple):
    """What goes out at once, and what was done to it."""

    data: bytes
    frames: int  # in it; 0 of an answer
    harm: FaultCounts | None = None


class Line:
    """Queue of lots that are due later; times are those of the host's clock, in ns.

    A frame or an answer that comes late is passed by others. Everything else keeps its order.
    """

    def __init__(self, plan: FaultPlan, seed: int) -> None:
        self._random = np.random.default_rng((seed, 2))
        self._delay_ns = round(plan.delay_ms * 1e6)
        self._clump_ns = round(plan.clump_ms * 1e6)
        self._late = {
            False: (plan.answer_delay_rate, round(plan.answer_delay_ms * 1e6)),
            True: (plan.frame_delay_rate, round(plan.frame_delay_ms * 1e6)),
        }
        # Whether lots are due at once, in the order in which they come.
        self.straight = not (self._delay_ns or self._clump_ns or any(rate for rate, _ in self._late.values()))
        self._due: deque[Lot] = deque()
        self._held: list[tuple[int, int, Lot]] = []  # a heap by time and number
        self._number = 0

    def put(self, lot: Lot, now_ns: int, frame_sequence: int | None = None) -> None:
        """Add a lot; `frame_sequence` of one single-tone frame is listed where it is delayed."""
        if self.straight:
            self._due.append(lot)
            return
        due_ns = now_ns + self._delay_ns
        rate, late_ns = self._late[lot.frames > 0]
        if rate > 0.0 and self._random.random() < rate:
            due_ns += late_ns
            lot = lot._replace(harm=_counted_late(lot, frame_sequence))
        if self._clump_ns:
            due_ns = -(-due_ns // self._clump_ns) * self._clump_ns
        self._number += 1
        heapq.heappush(self._held, (due_ns, self._number, lot))

    def has_due(self, now_ns: int) -> bool:
        return bool(self._due) or bool(self._held and self._held[0][0] <= now_ns)

    def pop(self, now_ns: int) -> Lot | None:
        """Remove and return what goes out next, None where nothing is due."""
        if self._due:
            return self._due.popleft()
        if not (self._held and self._held[0][0] <= now_ns):
            return None
        lot = heapq.heappop(self._held)[2]
        if self._clump_ns:  # as one transfer of the adapter
            clump = [lot]
            while self._held and self._held[0][0] <= now_ns:
                clump.append(heapq.heappop(self._held)[2])
            lot = _joined(clump) if len(clump) > 1 else lot
        return lot

    @property
    def next_due_ns(self) -> int | None:
        return self._held[0][0] if self._held else None

    @property
    def frames(self) -> int:
        """Frames that are held."""
        return sum(lot.frames for lot in self._due) + sum(lot.frames for _, _, lot in self._held)

    def clear(self) -> None:
        self._due.clear()
        self._held.clear()


class Splitter:
    """Limit on the bytes of the next write: pieces of random length, and no more than a slow reader accepts."""

    def __init__(self, plan: FaultPlan, seed: int) -> None:
        self._random = np.random.default_rng((seed, 3))
        self._split_bytes = plan.split_bytes
        self._bytes_per_ns = math.inf if plan.slow_reader_bytes_per_s is None else plan.slow_reader_bytes_per_s * 1e-9
        self._most_bytes = max(1.0, self._bytes_per_ns * _ALLOWANCE_S * 1e9) if self._bytes_per_ns else 0.0
        self._allowed_bytes = self._most_bytes
        self._counted_ns = 0
        self.unlimited = self._split_bytes is None and math.isinf(self._bytes_per_ns)

    def piece_bytes(self, wanted_bytes: int, now_ns: int) -> int:
        """Return how many of the wanted bytes may be written now; 0: none before `next_ns`."""
        if not math.isinf(self._bytes_per_ns):
            grown = self._allowed_bytes + (now_ns - self._counted_ns) * self._bytes_per_ns
            self._allowed_bytes = min(self._most_bytes, grown)
            self._counted_ns = now_ns
            wanted_bytes = min(wanted_bytes, int(self._allowed_bytes))
        if self._split_bytes is not None and wanted_bytes:
            wanted_bytes = min(wanted_bytes, int(self._random.integers(1, self._split_bytes + 1)))
        return wanted_bytes

    def wrote(self, size_bytes: int) -> None:
        self._allowed_bytes -= size_bytes

    @property
    def takes_more(self) -> bool:
        """Whether the next byte may be written as soon as the link can be."""
        return self._allowed_bytes >= 1.0

    @property
    def next_ns(self) -> int | None:
        """When a slow reader takes more again; None while it does, and where it will never."""
        if self.takes_more or not self._bytes_per_ns:
            return None
        return self._counted_ns + math.ceil((1.0 - self._allowed_bytes) / self._bytes_per_ns)


def _joined(lots: list[Lot]) -> Lot:
    harm = FaultCounts()
    for lot in lots:
        if lot.harm is not None:
            harm.add(lot.harm)
    return Lot(b"".join(lot.data for lot in lots), sum(lot.frames for lot in lots), harm)


def _counted_late(lot: Lot, frame_sequence: int | None) -> FaultCounts:
    harm = FaultCounts()
    if lot.harm is not None:
        harm.add(lot.harm)
    if lot.frames:
        harm.frames_delayed += 1
    else:
        harm.answers_delayed += 1
    if frame_sequence is not None:
        harm.frame_sequences_delayed.append(frame_sequence)
    return harm
