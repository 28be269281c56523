"""Output queue of a board: packets that wait for the link, dropped frames, and STATUS (PROTOCOL.md, section 5)."""

from collections import deque
from typing import NamedTuple

from firmware_protocol.device import DeviceSession
from firmware_protocol.messages import BoardStatus


class Outgoing(NamedTuple):
    """Packets that are sent together: an answer, or all parts of a frame, after a STATUS if that is due."""

    data: bytes
    sequence: int | None = None  # of a frame; None for other packets

    @property
    def is_frame(self) -> bool:
        return self.sequence is not None


class OutputQueue:
    """Queue of `limit_bytes` behind a session; when it is full, its oldest whole frames are dropped and counted.

    `frames_taken` counts the frames of the run that have left the queue, to be sent whole.
    """

    def __init__(self, session: DeviceSession, limit_bytes: int) -> None:
        self._session = session
        self._limit_bytes = limit_bytes
        self._waiting: deque[Outgoing] = deque()
        self._bytes = 0
        self._frames_reported = 0  # as dropped, in the last STATUS of this run
        self.frames_taken = 0

    @property
    def frames(self) -> int:
        """Number of frames in the queue."""
        return sum(outgoing.is_frame for outgoing in self._waiting)

    def begin_run(self) -> None:
        """Drop the frames of the last run: those of this one have the same numbers."""
        self._waiting = deque(outgoing for outgoing in self._waiting if not outgoing.is_frame)
        self._bytes = sum(len(outgoing.data) for outgoing in self._waiting)
        self.frames_taken = self._frames_reported = 0

    def begin(self) -> None:
        """Become idle and empty the output: a host begins afresh."""
        self._session.begin()
        self._drop_all(0)

    def connection_ended(self, frames_cut: int = 0) -> None:
        """Empty the output; `frames_cut`: frames that were taken, and of which not all bytes have gone out."""
        self._session.connection_ended()
        self._drop_all(frames_cut)

    def host_connects(self, board_ticks: int, frames_cut: int = 0) -> bool:
        """Return whether to serve a new TCP connection, which ends the former one; if not, close the new one."""
        served = self._session.host_connects(board_ticks)
        if served:
            self._drop_all(frames_cut)
        return served

    def put(self, outgoing: Outgoing) -> int:
        """Queue packets; return how many frames were dropped for lack of room, including this one.

        A frame before the host's first request is dropped without being counted here.
        """
        if outgoing.is_frame and not self._session.asked:
            return 0
        dropped, size_bytes = 0, len(outgoing.data)
        while self._bytes + size_bytes > self._limit_bytes:
            oldest = next((index for index, waiting in enumerate(self._waiting) if waiting.is_frame), None)
            if oldest is None:
                return dropped + outgoing.is_frame
            self._bytes -= len(self._waiting[oldest].data)
            del self._waiting[oldest]
            dropped += 1
        self._waiting.append(outgoing)
        self._bytes += size_bytes
        return dropped

    def set_fault(self, reason: str | None, board_ticks: int) -> None:
        """Set or clear the session's fault; frames make room for its LOG, as for an answer."""
        if log := self._session.set_fault(reason, board_ticks):
            self.put(Outgoing(log))

    def take(self, board_ticks: int) -> Outgoing | None:
        """Remove and return the next output; a frame that follows a drop comes with its STATUS."""
        if not self._waiting:
            return None
        outgoing = self._waiting.popleft()
        self._bytes -= len(outgoing.data)
        sequence = outgoing.sequence
        if sequence is None:
            return outgoing
        dropped = sequence - self.frames_taken  # all frames before this one that did not go out
        self.frames_taken += 1
        if dropped == self._frames_reported:
            return outgoing
        self._frames_reported = dropped
        report = BoardStatus(dropped, bytes_discarded=self._session.counts.discarded)
        return Outgoing(self._session.status(report, board_ticks) + outgoing.data, sequence)

    def _drop_all(self, frames_cut: int) -> None:
        self._waiting.clear()
        self._bytes = 0
        self.frames_taken -= frames_cut
