"""What a connection handles besides frames and clock: the board's log, and requests to blink."""

from collections.abc import Mapping

from firmware_protocol.host import HostSession, Located
from firmware_protocol.messages import BoardLog, ResetCause
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import BlinkAnswered, BoardLogLine, LinkCounters

_LOG_LINES_A_SECOND = 20
_S = 1_000_000_000

RESET_CAUSES: Mapping[int, str] = {
    ResetCause.POWER_ON: ", switched on",
    ResetCause.BROWN_OUT: " after a brown-out: look at its supply",
    ResetCause.WATCHDOG: ", by its watchdog",
    ResetCause.SOFTWARE: ", by its software",
    ResetCause.RESET_PIN: ", by its reset pin",
}
"""Why a board restarted, as the end of a sentence; other causes add nothing."""


class BoardLogFilter:
    """Filter that passes at most 20 lines a second of a board's log; the others are counted."""

    def __init__(self, queue: FrameQueue, counters: LinkCounters) -> None:
        self._queue = queue
        self._counters = counters
        self._second = self._lines = 0

    def put(self, line: BoardLog, now_ns: int) -> None:
        second = now_ns // _S
        if second != self._second:
            self._second, self._lines = second, 0
        self._lines += 1
        if self._lines <= _LOG_LINES_A_SECOND:
            self._queue.put(BoardLogLine(line.level, line.text))
        else:
            self._counters.log_lines_dropped += 1


_ASK_AGAIN_NS = 300_000_000
_ANSWER_NS = 3_000_000_000


class BlinkRequests:
    """Requests to blink of one connection; the answers go to the frame queue."""

    def __init__(self, queue: FrameQueue) -> None:
        self._queue = queue
        self._asked_ns = 0
        self.due_ns: int | None = None  # when it is to be asked again; None while nothing is asked

    def ask(self, session: HostSession, now_ns: int) -> None:
        self._asked_ns, self.due_ns = now_ns, now_ns + _ASK_AGAIN_NS
        session.locate()

    def run_timers(self, session: HostSession, now_ns: int) -> None:
        """Ask again, or give up, when it is time to."""
        if self.due_ns is None or now_ns < self.due_ns:
            return
        if now_ns - self._asked_ns >= _ANSWER_NS:
            self._end(f"the board did not answer within {_ANSWER_NS // 1_000_000_000} s")
        else:
            self.due_ns = now_ns + _ASK_AGAIN_NS
            session.locate()

    def answered(self, event: Located) -> None:
        self._end(event.refusal.text if event.refusal is not None else None)

    def close(self) -> None:
        """Answer what is still open: the link is closed."""
        self._end("the link was closed before the board had answered")

    def _end(self, refused: str | None) -> None:
        if self.due_ns is not None:
            self.due_ns = None
            self._queue.put(BlinkAnswered(refused))
