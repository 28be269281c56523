"""Messages of a board for people: why it started, and the lines of its log."""

from firmware_protocol.messages import BoardLog, ResetCause
from resonator_daemon.session.counters import LinkCounters
from resonator_daemon.session.frame_queue import FrameQueue
from resonator_daemon.session.frames import BoardLogLine

_LOG_LINES_A_SECOND = 20
_S = 1_000_000_000


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


def reset_cause_text(reset_cause: int | None) -> str:
    """Return why a board started anew, as the end of a sentence."""
    match reset_cause:
        case ResetCause.POWER_ON:
            return ", switched on"
        case ResetCause.BROWN_OUT:
            return " after a brown-out: look at its supply"
        case ResetCause.WATCHDOG:
            return ", by its watchdog"
        case ResetCause.SOFTWARE:
            return ", by its software"
        case ResetCause.RESET_PIN:
            return ", by its reset pin"
        case _:
            return ""
