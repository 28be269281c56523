"""What follows from each event on a link: connections, frames, accounts and states, live and from a recording alike."""

import threading
from collections.abc import Callable

from firmware_protocol.host import Described
from resonator_daemon.config import frame_bytes
from resonator_daemon.plate import Plate
from resonator_daemon.session.compatibility import gate_ticks
from resonator_daemon.session.connection import Connection
from resonator_daemon.session.counters import FrameLoss, LinkAccount
from resonator_daemon.session.frame_numbers import FrameNumbering
from resonator_daemon.session.frame_queue import Ring
from resonator_daemon.session.frames import BoardRefused, Steering
from resonator_daemon.session.host_time import HostTime
from resonator_daemon.session.link_events import (
    Closed,
    Goodbye,
    Locate,
    Lost,
    Opened,
    Overrun,
    Received,
    Refused,
    Said,
    Sent,
    Skipped,
    Standing,
    Steered,
    Tended,
    WireEvent,
)
from resonator_daemon.session.link_snapshot import CourseStanding
from resonator_daemon.session.link_state import LinkState

_STANDING_EVERY_NS = 100_000_000


class LinkCourse:
    """Follows one link through any number of connections; it depends on its events alone.

    Parameters
    ----------
    ring
        Takes the frames and the news.
    tap
        Is handed each event before anything follows from it; about every 100 ms it is told how the link stands.
    """

    def __init__(self, plate: Plate, ring: Ring, tap: Callable[[WireEvent], None]) -> None:
        self._plate = plate
        self._ring = ring
        self._tap = tap
        self._numbering = FrameNumbering(
            frame_bytes(plate), gate_ticks(plate), round(1e9 / plate.counter.frame_rate_hz)
        )
        self._lock = threading.Lock()  # held while a chunk is taken apart, so that accounts are whole
        self._account = LinkAccount()
        self._known: Described | None = None
        self._state = LinkState(ring.put)
        self._standing_due_ns = 0
        self.connection: Connection | None = None

    def apply(self, event: WireEvent) -> None:
        """Do what follows from the event.

        Raises
        ------
        BoardRefusedError, LinkLostError
            By what was received or tended: `Refused` or `Lost` is to follow, then `Closed`.
        ValueError
            An event of an open link, and none is open; or `Opened`, and one is.
        """
        if isinstance(event, Received) and event.now.monotonic_ns >= self._standing_due_ns:
            self._tell_standing(event.now)
        self._tap(event)
        match event:
            case Received():
                with self._lock:
                    self._opened().receive(event.data, event.now)
            case Tended():
                with self._lock:
                    self._opened().tend(event.now, idle=event.idle)
            case Said():
                self._state.say(event.state, event.reason, event.now.utc_ns)
                self._tell_standing(event.now)
            case Opened():
                self._open(event.now)
            case Overrun():
                with self._lock:
                    self._opened().overrun()
            case Goodbye():
                self._opened().say_goodbye()
            case Lost():
                if self._state.state != "stalled":
                    state = "lost" if self._opened().was_online else "waiting"
                    self._state.say(state, event.reason, event.now.utc_ns)
            case Refused():
                self._state.say("refused", "; ".join(event.problems), event.now.utc_ns)
                self._ring.put(BoardRefused(event.problems, event.other_protocol))
            case Closed():
                self._close()
                self._tell_standing(event.now)
            case Sent():
                self._opened().sent(event.data, event.now)
            case Locate():
                self._opened().locate(event.now)
            case Standing():
                self._join(event)
            case Steered():
                self._ring.put(Steering(event.key, event.order))
            case Skipped():
                pass

    def data_to_send(self) -> bytes:
        """Return and clear the bytes that the board must get, at once."""
        return self._opened().data_to_send()

    def due_ns(self) -> int:
        """Return the monotonic time at which something is to be tended."""
        return self._opened().due_ns()

    @property
    def awaits_answer(self) -> bool:
        """Whether a ping is on its way: the sooner its answer is read, the better the time is known."""
        return self._opened().awaits_answer

    @property
    def within_packet(self) -> bool:
        """Whether the last bytes that were received end in the middle of a packet."""
        return self._opened().within_packet

    @property
    def was_online(self) -> bool:
        """Whether the board has counted since the link was opened."""
        return self._opened().was_online

    def account(self) -> LinkAccount:
        """Return where every byte and frame went, as of now."""
        with self._lock:
            account = self._account.copy()
            if self.connection is not None:
                self.connection.add_to(account)
        account.lost += self._ring.loss
        return account

    @property
    def lost(self) -> FrameLoss:
        """Frames lost since the start, by cause."""
        return self._account.lost + self._ring.loss

    def _opened(self) -> Connection:
        if self.connection is None:
            raise ValueError("no link is open")
        return self.connection

    def _open(self, now: HostTime) -> None:
        if self.connection is not None:
            raise ValueError("the link is open already")
        connection = Connection(self._plate, self._known, self._numbering, self._ring, self._account, self._state, now)
        with self._lock:
            self.connection = connection
            self._account.connections += 1

    def _tell_standing(self, now: HostTime) -> None:
        """Tell the tap how the link stands, unless a packet, a frame or a handshake is under way."""
        running = self.connection.standing() if self.connection is not None else None
        if running is None and self.connection is not None:
            return
        standing = CourseStanding(self._state.standing, self._numbering.standing, self._known, running)
        self._tap(Standing(now, standing))
        self._standing_due_ns = now.monotonic_ns + _STANDING_EVERY_NS

    def _join(self, standing: Standing) -> None:
        if self.connection is not None:
            raise ValueError("the link is open already")
        state, numbers, self._known, running = standing.course
        self._numbering.join(numbers)
        self._state.join(state, standing.now.utc_ns)
        if running is not None:
            self._open(standing.now)
            self._opened().join(running)

    def _close(self) -> None:
        connection = self._opened()
        if connection.was_online:
            self._known = connection.described
        with self._lock:
            self.connection = None
            connection.close()
