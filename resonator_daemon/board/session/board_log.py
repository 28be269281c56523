"""Log of a board: why it started, and the lines of its log."""

from collections.abc import Mapping

from firmware_protocol.messages import BoardLog, ResetCause
from resonator_daemon.board.session.counters import LinkCounters
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import BoardLogLine

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
