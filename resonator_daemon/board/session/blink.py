"""Requests to blink: repeated until the board answers, each with an answer in any case."""

from firmware_protocol.host import HostSession, Located
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import BlinkAnswered

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
