"""Reader of one board on one link: identify, configure, run, reconnect, in a thread of its own."""

import random
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, Self

from resonator_daemon.base.host.load import HostLoad, LoadMeter
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Condition
from resonator_daemon.board.links.hot_plug import PortWatch
from resonator_daemon.board.links.link import Link, LinkLostError, LinkUnavailableError
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.session.clock import HostTime, read_host_time
from resonator_daemon.board.session.compatibility import BoardRefusedError
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import (
    Arrival,
    BlinkAnswered,
    ChannelisedFrame,
    ControlRequest,
    LinkChange,
    LinkCounters,
    Outage,
    ReaderFailed,
    SingleToneFrame,
)
from resonator_daemon.board.session.link_events import (
    BlinkRequested,
    Closed,
    ControlRequested,
    Lost,
    Opened,
    Overrun,
    Received,
    Refused,
    Sent,
    StateAnnounced,
    StopRequested,
    TimersRun,
    WireEvent,
)
from resonator_daemon.board.session.link_state import OPENING, LinkLog
from resonator_daemon.board.session.link_state_machine import LinkStateMachine

_EARLY_NS: Final = 15_000  # by which the lag grows after a read that came too early
_RIGHT_NS: Final = 3_000  # by which it shrinks after a read that found the whole step
_LAG_MAX_NS: Final = 500_000
_SLEEP_MAX_NS: Final = 5_500_000
_SLEEP_BYTES_MAX: Final = 2048  # half of what a pseudo-terminal holds


class StepPacing:
    """Predicts when the last frame of a step can be read.

    A frame can be read some time after the end of its gate: the lag of board, link and kernel. The lag is estimated
    from the outcome of earlier reads, so that about one read in six comes too early. Such a read then waits for the
    rest of the step, at no delay. A lag that few frames exceed would delay all others.

    Parameters
    ----------
    frame_bytes
        Size of a frame on the wire.
    frame_ns
        Time from frame to frame.

    Attributes
    ----------
    small_frames
        Whether the link's buffers hold more than a frame; for others, nothing is predicted.
    awaited_index
        Index of the frame that the next read should find; None if none is predicted.
    """

    def __init__(self, frame_bytes: int, frame_ns: int) -> None:
        self._frame_ns = frame_ns
        self._sleep_max_ns = min(_SLEEP_MAX_NS, _SLEEP_BYTES_MAX * frame_ns // frame_bytes)
        self.small_frames = self._sleep_max_ns > frame_ns
        self._lag_ns = 0
        self.awaited_index: int | None = None

    def sleep_ns(
        self, now_ns: int, newest_index: int, newest_middle_ns: int, step_frames: Sequence[int], limit_ns: int
    ) -> int:
        """Return how long to wait before the next read, at most as long as the link's buffers hold.

        Parameters
        ----------
        now_ns
            Monotonic time of the host.
        newest_index, newest_middle_ns
            Of the last frame that was read: index, and the middle of its gate by the monotonic clock.
        step_frames
            Frames whose index, counted from 1, is a multiple of any of these numbers complete a step.
        limit_ns
            Monotonic time at which the reader has something else to do.
        """
        self.awaited_index = None
        count = newest_index + 1
        frames = step_frames[0] - count % step_frames[0]
        for step in step_frames[1:]:
            frames = min(frames, step - count % step)
        end_ns = newest_middle_ns + self._frame_ns * frames + self._frame_ns // 2
        wait_ns = end_ns + self._lag_ns - now_ns
        longest_ns = min(limit_ns - now_ns, self._sleep_max_ns)
        if wait_ns <= longest_ns:
            self.awaited_index = newest_index + frames
        return max(0, min(wait_ns, longest_ns))

    def has_read(self, newest_index: int) -> None:
        """Correct the lag by the outcome of the read after `sleep_ns`."""
        if self.awaited_index is not None:
            lag_ns = self._lag_ns + _EARLY_NS if newest_index < self.awaited_index else self._lag_ns - _RIGHT_NS
            self._lag_ns = min(max(lag_ns, 0), _LAG_MAX_NS)
            self.awaited_index = None


FRAME_QUEUE_BYTES = 64 << 20

_POLL_NS = 20_000_000  # the longest that `stop` waits for a read
_BACKOFF_FIRST_S = 0.05
_JITTER = (0.75, 1.25)  # so that several daemons do not open in step
_REFUSED_S = 5.0
_PIECES, _QUICK_S = 100, 50e-6  # read at most before they are looked at, where an answer may be among them
_FEW_BYTES, _GATHER_S = 64, 250e-6


Replay = Callable[[LinkStateMachine, Callable[[float], object], Callable[[], bool]], None]
"""Applies recorded events to a state machine; gets what waits for so many seconds, and what returns True to stop."""


class BoardReader:
    """Reader of one board until `stop`; reconnects after each loss of the link.

    Parameters
    ----------
    target
        Where the board is.
    plate
        What the board must serve; decides the gate.
    wake
        Called from the reader's thread when there are arrivals.
    step_frames
        How many frames are of use together: `wake` waits until there are a multiple of any of these numbers.
    frame_queue_bytes
        Bound of the memory of frames that nobody takes.
    on_event
        Receives every event on the link, for a recorder; must not wait.

    replay
        Replays the recording that `target` names, from `recording.event_replay`; None where it names a board.
    backoff_max_s
        The longest pause between two attempts to open the link.

    Attributes
    ----------
    turns
        Number of turns of the reader's loop, which shows that it is alive.
    queue
        What has arrived; `step_frames` may be replaced.
    machine
        State of the link, and its counters.
    """

    def __init__(
        self,
        target: LinkTarget,
        plate: Plate,
        wake: Callable[[], None],
        *,
        step_frames: Sequence[int] = (1,),
        frame_queue_bytes: int = FRAME_QUEUE_BYTES,
        on_event: Callable[[WireEvent], None] = lambda _: None,
        replay: Replay | None = None,
        backoff_max_s: float = 1.0,
    ) -> None:
        if (replay is None) != (target.recording_path is None):
            raise ValueError(f"{target}: a recording needs what replays it, a board must not have it")
        self._backoff_max_s = backoff_max_s
        self._replay = replay
        self._open = target.opener()
        self._plate = plate
        self._wake = wake
        self._wake_due = False
        self.queue = FrameQueue(frame_queue_bytes, self._wake_soon, step_frames)
        self.machine = LinkStateMachine(plate, self.queue, on_event)
        self._pacing = StepPacing(plate.frame_bytes, round(1e9 / plate.counter.frame_rate_hz))
        self._log = LinkLog()
        self._stopping = False
        self._requests: deque[tuple[str, str]] = deque()
        self.turns = 0
        self._watch = PortWatch(target.appears_at)
        self._thread = threading.Thread(target=self._run, name="board-reader", daemon=True)
        self._blink_lock = threading.Lock()
        self._on_blink_answer: list[Callable[[str | None], None]] = []  # waiting for an answer
        self._blink_due = self._link_open = self._serving = False

    def start(self) -> None:
        if not self.replays:  # a recording has its own first state
            self.machine.apply(StateAnnounced(read_host_time(), Condition.STARTING, OPENING))
        self._thread.start()

    def stop(self) -> None:
        """End the thread, if it was started, and give the port back; returns when both are done."""
        self._stopping = True
        self._watch.wake()
        if self._thread.ident is not None:
            self._thread.join()

    def pop_arrivals(self) -> list[Arrival]:
        """Return what has arrived since the last call, in order."""
        arrivals = self.queue.pop_all()
        if not arrivals:
            self._log.flush()
        for arrival in arrivals:
            if isinstance(arrival, SingleToneFrame | ChannelisedFrame):
                continue
            if isinstance(arrival, LinkChange | Outage):
                self._log.write(arrival)
            elif isinstance(arrival, BlinkAnswered):
                with self._blink_lock:
                    waiting, self._on_blink_answer = self._on_blink_answer, []
                for done in waiting:
                    done(arrival.refused)
        return arrivals

    def flush_log(self) -> None:
        """Write the sum of frequent changes of the link's state if it is due; `pop_arrivals` does so, too."""
        self._log.flush()

    def blink(self, done: Callable[[str | None], None]) -> None:
        """Ask the board to blink while it counts on; from any thread.

        `pop_arrivals` calls `done` with None, or with the reason why the board does not blink. It does so in any case,
        unless the reader is stopped before.
        """
        with self._blink_lock:
            self._on_blink_answer.append(done)
            self._blink_due = self._link_open
            if self._link_open:
                return
        self.queue.put(BlinkAnswered("a recording has no board" if self.replays else "no board is connected"))

    def request_control(self, key: str, request: str) -> None:
        """Pass a request on after all frames that have arrived; a recording holds it in the same place."""
        if self.replays:  # what is recorded there was recorded before
            self.queue.put(ControlRequest(key, request))
        else:
            self._requests.append((key, request))
            self._watch.wake()

    def counters(self) -> LinkCounters:
        """Return where every byte and frame went, as of now."""
        return self.machine.counters()

    @property
    def replays(self) -> bool:
        """Whether a recording is read: its frames have no age."""
        return self._replay is not None

    @property
    def load(self) -> HostLoad:
        """Load of the computer while a link is open."""
        connection = self.machine.connection  # the reader's thread may close it meanwhile
        return connection.load if connection else HostLoad()

    @property
    def clock_rate_ppm(self) -> float:
        """How much slower than nominal the board's ticks run; NaN while no board is there."""
        connection = self.machine.connection
        clock = connection.clock if connection else None  # the reader's thread may close it meanwhile
        return clock.rate_ppm if clock else float("nan")

    def _wake_soon(self) -> None:
        """Wake the consumer; from the reader's thread before it waits next, so that both do not compete till then."""
        self._wake_due = True
        if not self._serving or threading.get_ident() != self._thread.ident:
            self._wake_now()

    def _wake_now(self) -> None:
        if self._wake_due:
            self._wake_due = False
            self._wake()

    def _run(self) -> None:
        try:
            if self._replay is None:
                self._keep_reading()
            else:
                try:
                    self._replay(self.machine, self._watch.wait, lambda: self._stopping)
                except LinkUnavailableError as error:  # another file does not come by waiting
                    self.machine.apply(Refused(read_host_time(), (error.reason,), other_protocol=False))
        except Exception as error:  # noqa: BLE001 - it is passed on as ReaderFailed, else frames would be awaited for ever
            self.queue.put(ReaderFailed(error))

    def _keep_reading(self) -> None:
        backoff_s = first_s = min(_BACKOFF_FIRST_S, self._backoff_max_s)
        while not self._stopping:
            self.turns += 1
            self._apply_requests(read_host_time())
            wait_s = 0.0
            try:
                link = self._open()
            except LinkUnavailableError as error:
                self.machine.apply(StateAnnounced(read_host_time(), Condition.WAITING, error.reason))
            else:
                try:
                    if self._serve(link):
                        backoff_s = first_s
                except BoardRefusedError:
                    wait_s = _REFUSED_S
                finally:
                    link.close()
            if not self._stopping and self._watch.wait(wait_s or backoff_s * random.uniform(*_JITTER)):
                backoff_s = first_s
            else:
                backoff_s = min(2 * backoff_s, self._backoff_max_s)

    def _serve(self, link: Link) -> bool:
        """Serve the link until it is lost; return whether the board ever counted."""
        machine = self.machine
        now = read_host_time()
        machine.apply(Opened(now))
        connection, meter = machine.opened, LoadMeter()
        outgoing = connection.session.requests.outgoing
        overruns = 0
        self._link_open = self._serving = True
        try:
            while not self._stopping:
                self.turns += 1
                if self._requests:
                    self._apply_requests(now)
                if outgoing:
                    self._send(link, now)
                if self._blink_due:
                    self._blink_due = False
                    machine.apply(BlinkRequested(now))
                    self._send(link, now)  # apart from a ping, so that a recording that starts here has its number
                due_ns = connection.due_ns()
                pieces = self._read(link, due_ns, gather=bool(connection.pings.on_the_way))
                if not pieces:
                    now = read_host_time()  # silence ends before a thread that was kept waiting looks
                    if data := link.read(0.0):
                        pieces = [Received(read_host_time(), data)]
                if link.overruns != overruns:
                    overruns = link.overruns
                    machine.apply(Overrun(read_host_time()))
                for piece in pieces:
                    machine.apply(piece)
                if self._pacing.awaited_index is not None:
                    self._pacing.has_read(self.queue.newest_index)
                if pieces:
                    now = pieces[-1].now
                if not pieces or now.monotonic_ns >= due_ns:
                    machine.apply(TimersRun(now, not pieces, meter.sample()))
                if pieces and len(pieces[-1].data) < _FEW_BYTES and connection.session.waiting_bytes:
                    # A UART with a short queue hands on some bytes at a time, and each would cost a turn of all this.
                    time.sleep(_GATHER_S)
            self._request_stop(link)
        except LinkLostError as error:
            machine.apply(Lost(read_host_time(), error.reason))
        except BoardRefusedError as error:
            machine.apply(Refused(read_host_time(), error.refused.problems, error.refused.other_protocol))
            with suppress(LinkLostError):  # a board that counts would fill a buffer that nobody empties
                self._request_stop(link)
            raise
        finally:
            self._serving = False
            self._wake_now()
            was_online = connection.was_online
            with self._blink_lock:
                self._link_open = False
                unasked, self._blink_due = self._blink_due, False
            machine.apply(Closed(read_host_time()))
            if unasked:
                self.queue.put(BlinkAnswered("the link was closed before the board was asked"))
        return was_online

    def _apply_requests(self, now: HostTime) -> None:
        while self._requests:
            self.machine.apply(ControlRequested(now, *self._requests.popleft()))

    def _read(self, link: Link, due_ns: int, *, gather: bool) -> list[Received]:
        """Read until a timer is due; `gather`: all that is there, each piece with its time."""
        now_ns = time.monotonic_ns()
        due_ns = min(due_ns, now_ns + _POLL_NS)
        queue, pacing = self.queue, self._pacing
        sleep_ns = 0
        if pacing.small_frames and not gather and queue.newest_index >= 0:
            sleep_ns = pacing.sleep_ns(now_ns, queue.newest_index, queue.newest_middle_ns, queue.step_frames, due_ns)
        if self._wake_due:
            self._wake_now()
        if sleep_ns:
            time.sleep(sleep_ns * 1e-9)
            if data := link.read(0.0):
                return [Received(read_host_time(), data)]
            now_ns = time.monotonic_ns()
        timeout_s = max(0, due_ns - now_ns) * 1e-9
        pieces: list[Received] = []
        while len(pieces) < _PIECES and (data := link.read(timeout_s)):
            pieces.append(Received(read_host_time(), data))
            if not gather or len(data) < _FEW_BYTES:
                break  # so few are the last of what there was, or a line hands them on one by one
            timeout_s = _QUICK_S
        return pieces

    def _request_stop(self, link: Link) -> None:
        now = read_host_time()
        self.machine.apply(StopRequested(now))
        self._send(link, now)

    def _send(self, link: Link, now: HostTime) -> None:
        if data := self.machine.opened.session.data_to_send():
            self.machine.apply(Sent(now, data))
            link.write(data)


class BlockingReader:
    """Reads a board from entry to exit.

    Parameters
    ----------
    target
        Link of the board.
    plate
    options
        Of `BoardReader`.

    Attributes
    ----------
    reader
    """

    def __init__(self, target: LinkTarget, plate: Plate, **options: Any) -> None:
        self._arrived = threading.Event()
        self.reader = BoardReader(target, plate, self._arrived.set, **options)

    def __enter__(self) -> Self:
        self.reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.stop()

    def wait(self, timeout_s: float) -> list[Arrival]:
        """Wait until something arrives, for `timeout_s` at most; return what has arrived."""
        self._arrived.wait(timeout_s)
        self._arrived.clear()
        return self.reader.pop_arrivals()
