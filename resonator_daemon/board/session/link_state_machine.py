"""State machine of a link: events to connections, frames, counters and states, live and from a recording."""

import threading
from collections.abc import Callable

from firmware_protocol.host import Described
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Condition
from resonator_daemon.board.session import link_events as wire
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.compatibility import gate_ticks
from resonator_daemon.board.session.connection import Connection
from resonator_daemon.board.session.frame_numbers import FrameNumbering
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import BoardRefused, ControlRequest, FrameLoss, LinkCounters
from resonator_daemon.board.session.link_events import LinkSnapshot
from resonator_daemon.board.session.link_state import LinkState, all_of

SNAPSHOT_EVERY_NS = 100_000_000


class LinkStateMachine:
    """Follows one link through any number of connections; it depends on its events alone.

    Parameters
    ----------
    queue
        Receives frames and events.
    on_event
        Receives each event before it is applied, and snapshots of the link between them.
    snapshot_every_ns
        Time between two snapshots, where the state of the link permits one.
    """

    def __init__(
        self,
        plate: Plate,
        queue: FrameQueue,
        on_event: Callable[[wire.WireEvent], None],
        *,
        snapshot_every_ns: int = SNAPSHOT_EVERY_NS,
    ) -> None:
        self._plate = plate
        self._queue = queue
        self._on_event = on_event
        self._numbering = FrameNumbering(plate.frame_bytes, gate_ticks(plate), round(1e9 / plate.counter.frame_rate_hz))
        self._lock = threading.Lock()  # held while a chunk is taken apart, so that counters are consistent
        self._counters = LinkCounters()
        self._known: Described | None = None
        self._state = LinkState(queue.put)
        self._snapshot_every_ns = snapshot_every_ns
        self._snapshot_due_ns = 0
        self.connection: Connection | None = None

    def apply(self, event: wire.WireEvent) -> None:
        """Do what follows from the event.

        Raises
        ------
        BoardRefusedError, LinkLostError
            By bytes or timers: `Refused` or `Lost` is to follow, then `Closed`.
        ValueError
            An event of an open link, and none is open; or `Opened`, and one is.
        """
        if isinstance(event, wire.Received):
            if event.now.monotonic_ns >= self._snapshot_due_ns:
                self._record_snapshot(event.now)
            self._on_event(event)
            with self._lock:
                (self.connection or self.opened).receive(event.data, event.now)
            return
        self._on_event(event)
        match event:
            case wire.TimersRun():
                with self._lock:
                    self.opened.run_timers(event.now, idle=event.idle, sample=event.load)
            case wire.StateAnnounced():
                self._state.announce(event.state, event.reason, event.now.utc_ns)
                self._record_snapshot(event.now)
            case wire.Opened():
                self._open(event.now)
            case wire.Overrun():
                with self._lock:
                    self.opened.overrun()
            case wire.StopRequested():
                self.opened.session.stop()
            case wire.Lost():
                if self._state.state is not Condition.STALLED:
                    state = Condition.LOST if self.opened.was_online else Condition.WAITING
                    self._state.announce(state, event.reason, event.now.utc_ns)
            case wire.Refused():
                self._state.announce(Condition.REFUSED, all_of(event.problems), event.now.utc_ns)
                self._queue.put(BoardRefused(event.problems, event.other_protocol))
            case wire.Closed():
                self._close()
                self._record_snapshot(event.now)
            case wire.Sent():
                self.opened.sent(event.data, event.now)
            case wire.BlinkRequested():
                self.opened.blink(event.now)
            case wire.SnapshotTaken():
                self.restore(event.snapshot, event.now)
            case wire.ControlRequested():
                self._queue.put(ControlRequest(event.key, event.request))
            case wire.Skipped():
                pass

    def counters(self) -> LinkCounters:
        """Return where every byte and frame went, as of now."""
        with self._lock:
            counters = self._counters.copy()
            if self.connection is not None:
                self.connection.add_to(counters)
        counters.lost += self._queue.loss
        return counters

    @property
    def frames(self) -> int:
        """Frames accepted since the start."""
        return self._counters.frames

    @property
    def lost(self) -> FrameLoss:
        """Frames lost since the start, by cause."""
        return self._counters.lost + self._queue.loss

    @property
    def opened(self) -> Connection:
        """The connection of the open link; ValueError where none is open."""
        if self.connection is None:
            raise ValueError("no link is open")
        return self.connection

    def _open(self, now: HostTime) -> Connection:
        if self.connection is not None:
            raise ValueError("the link is open already")
        connection = Connection(
            self._plate, self._known, self._numbering, self._queue, self._counters, self._state, now
        )
        with self._lock:
            self.connection = connection
            self._counters.connections += 1
        return connection

    def snapshot(self) -> LinkSnapshot | None:
        """Return the state of the link; None while a packet, a frame or a handshake is under way."""
        running = None
        if self.connection is not None and (running := self.connection.snapshot()) is None:
            return None
        return LinkSnapshot(self._state.snapshot(), self._numbering.snapshot(), self._known, running)

    def restore(self, snapshot: LinkSnapshot, now: HostTime) -> None:
        """Set the state of a link that is not open; ValueError where it is."""
        if self.connection is not None:
            raise ValueError("the link is open already")
        state, numbers, self._known, running = snapshot
        self._numbering.restore(numbers)
        self._state.restore(state, now.utc_ns)
        if running is not None:
            self._open(now).restore(running)

    def _record_snapshot(self, now: HostTime) -> None:
        if (snapshot := self.snapshot()) is not None:
            self._on_event(wire.SnapshotTaken(now, snapshot))
            self._snapshot_due_ns = now.monotonic_ns + self._snapshot_every_ns

    def _close(self) -> None:
        connection = self.opened
        if connection.was_online:
            self._known = connection.described
        with self._lock:
            self.connection = None
            connection.close()
