"""Data path from a board's queue to its link: damage, then timing, then as many bytes as the host accepts."""

from collections.abc import Callable

from simulators.board import Board
from simulators.faults import FaultPlan
from simulators.faults.account import FaultCounts
from simulators.faults.byte_faults import ByteFaults
from simulators.faults.timing import Line, Lot, Splitter
from simulators.links import Link


class Output:
    """Writer that empties a board's queue only as its link accepts bytes, so that a full queue is the board's own.

    Times are those of the host's clock, in ns.
    """

    def __init__(self, board: Board, link: Link, plan: FaultPlan, seed: int) -> None:
        self._board = board
        self._link = link
        self._faults = ByteFaults(plan, seed)
        self._line = Line(plan, seed)
        self._splitter = Splitter(plan, seed)
        self.faultless = self._faults.harmless and self._line.straight
        self._unlimited = self._splitter.unlimited
        self._lot: Lot | None = None  # is being written
        self._unsent: bytes | memoryview = b""  # of it
        self._after_cut: Callable[[], None] | None = None
        self.held = False  # the board is frozen: what it has sent already still arrives
        self.counts = FaultCounts()
        self.frames_sent = 0
        self.bytes_sent = 0

    @property
    def frames_unsent(self) -> int:
        """Frames that left the board and not the link."""
        return self._line.frames + (self._lot.frames if self._lot is not None else 0)

    def waits_for(self) -> tuple[bool, int | None]:
        """Return whether the next bytes go out as soon as the link can be written, and when something is due.

        The latter is also when a slow reader takes more again; None where only others can move it.
        """
        if self._lot is not None:
            return self._splitter.takes_more, self._splitter.next_ns
        return False, None if self.faultless else self._line.next_due_ns

    def cut_next_frame(self, then: Callable[[], None]) -> None:
        """Write only the first half of the next frame, then call `then`, which ends the board; at once without host."""
        self._after_cut = then

    def send(self, now_ns: int, elapsed_s: float) -> None:
        """Write what can be written now, `elapsed_s` after the first START."""
        link = self._link
        simple = self.faultless and self._unlimited and self._lot is None and self._after_cut is None and not self.held
        if simple and self._send_whole():
            return
        while link.write_fd is not None:
            if self._lot is None:
                self._lot = self._next_lot(now_ns, elapsed_s)
                if self._lot is None:
                    return
                self._unsent = self._lot.data
            if not self._write(self._lot, now_ns) and link.write_fd is not None:
                return  # the host does not take more now
        self.lose()

    def _send_whole(self) -> bool:
        """Write what the board has, the short way of most frames; return whether the host has taken all of it."""
        link, next_output = self._link, self._board.next_output
        while link.write_fd is not None:
            if (outgoing := next_output()) is None:
                return True
            data, is_frame = outgoing.data, outgoing.sequence is not None
            written = link.write(data)
            self.bytes_sent += written
            if written < len(data):
                self._lot, self._unsent = Lot(data, is_frame), memoryview(data)[written:]
                break
            self.frames_sent += is_frame
        return False

    def host_connects(self, now_ticks: int) -> bool:
        """Return whether to serve a new TCP connection; if so, discard the output for the former one."""
        served = self._board.host_connects(now_ticks, self.frames_unsent)
        if served:
            self.clear()
        return served

    def lose(self) -> None:
        """Discard everything that waits: the host is gone."""
        self._board.connection_ended(self.frames_unsent)
        self.clear()
        self._end_board()

    def clear(self) -> None:
        """Discard what has left the board's queue and not the link."""
        self._lot, self._unsent = None, b""
        self._line.clear()

    def _next_lot(self, now_ns: int, elapsed_s: float) -> Lot | None:
        """Return the lot that is written next; None if none is due."""
        if self.held:
            return self._line.pop(now_ns)
        if self.faultless and self._after_cut is None:
            outgoing = self._board.next_output()
            return None if outgoing is None else Lot(outgoing.data, 0 if outgoing.sequence is None else 1)
        self._fill_line(now_ns, elapsed_s)
        return self._line.pop(now_ns)

    def _fill_line(self, now_ns: int, elapsed_s: float) -> None:
        """Move packets from the board to the line until something is due."""
        while not self._line.has_due(now_ns) and (outgoing := self._board.next_output()) is not None:
            sequence = outgoing.sequence if self._board.single_tone else None
            if self._after_cut is not None and outgoing.is_frame:
                harm = FaultCounts(frame_sequences_cut=[] if sequence is None else [sequence])
                self._line.put(Lot(outgoing.data[: len(outgoing.data) // 2], frames=0, harm=harm), now_ns)
                self._end_board()
                continue
            data, harm_done = self._faults.damage(outgoing.data, elapsed_s)
            self._line.put(Lot(data, int(outgoing.is_frame), harm_done), now_ns, sequence)

    def _end_board(self) -> None:
        if self._after_cut is not None:
            then, self._after_cut = self._after_cut, None
            then()

    def _write(self, lot: Lot, now_ns: int) -> bool:
        """Write a piece of the lot; return whether more may be tried at once."""
        piece = self._unsent
        if not self._unlimited:
            piece = piece[: self._splitter.piece_bytes(len(piece), now_ns)]
        written = self._link.write(piece) if piece else 0
        if not self._unlimited:
            self._splitter.wrote(written)
        self.bytes_sent += written
        if written < len(self._unsent):
            self._unsent = memoryview(self._unsent)[written:]
        else:
            self.frames_sent += lot.frames
            if lot.harm is not None:
                self.counts.add(lot.harm)
            self._lot, self._unsent = None, b""
        return 0 < written == len(piece)
