"""One board on one link: identify, configure, run, reconnect, in a thread that nothing behind it can slow."""

import logging
import random
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from resonator_daemon.acquisition.connection import BoardRefusedError, Connection
from resonator_daemon.acquisition.fit import gate_ticks
from resonator_daemon.acquisition.frames import (
    Arrival,
    FrameLoss,
    LinkAccount,
    LinkChange,
    ReaderFailed,
)
from resonator_daemon.acquisition.link import Link, LinkLostError, LinkUnavailableError
from resonator_daemon.acquisition.numbering import FrameNumbering
from resonator_daemon.acquisition.ring import Ring
from resonator_daemon.acquisition.serial_link import open_serial
from resonator_daemon.acquisition.tcp_link import open_tcp
from resonator_daemon.config import SerialLink, TcpLink, frame_bytes
from resonator_daemon.plate import Plate

log = logging.getLogger(__name__)

RING_BYTES = 64 << 20

_POLL_S = 0.02  # how often timers are looked at while nothing arrives
_BACKOFF_FIRST_S, _BACKOFF_CAP_S = 0.05, 1.0
_REFUSED_S = 5.0


class BoardReader:
    """Reads one board for as long as it is wanted, whatever happens to the cable.

    Parameters
    ----------
    target
        Where the board is.
    plate
        What the board must serve; decides the gate.
    wake
        Called from the reader's thread when `take` has something to give.
    step_frames
        How many frames are of use together; `wake` waits for them.
    ring_bytes
        Bound of what is kept while nobody takes it.
    """

    def __init__(
        self,
        target: SerialLink | TcpLink,
        plate: Plate,
        wake: Callable[[], None],
        *,
        step_frames: int = 1,
        ring_bytes: int = RING_BYTES,
    ) -> None:
        self._target = target
        self._plate = plate
        self._ring = Ring(ring_bytes, wake, step_frames)
        self._numbering = FrameNumbering(
            frame_bytes(plate), gate_ticks(plate), round(1e9 / plate.counter.frame_rate_hz)
        )
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="board-reader", daemon=True)
        self._lock = threading.Lock()  # held while a chunk is taken apart, so that accounts are whole
        self._account = LinkAccount()
        self._connection: Connection | None = None
        self._state = LinkChange("starting", "the link is being opened", time.time_ns())

    def start(self) -> None:
        self._ring.put(self._state)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and give the port back; returns when both are done."""
        self._stop.set()
        self._thread.join()

    def take(self) -> list[Arrival]:
        """Return what has arrived since the last call, in order."""
        return self._ring.take()

    def account(self) -> LinkAccount:
        """Return where every byte and frame went, as of now."""
        with self._lock:
            account = replace(self._account)
            if self._connection is not None:
                self._connection.add_to(account)
        account.lost = account.lost + self._ring.loss
        return account

    @property
    def lost(self) -> FrameLoss:
        """Frames lost since the start, by cause."""
        return self._account.lost + self._ring.loss

    @property
    def clock_rate_ppm(self) -> float:
        """How much slower than nominal the board's ticks run; NaN while no board is there."""
        connection = self._connection
        clock = connection.clock if connection else None  # the reader's thread may forget it meanwhile
        return clock.rate_ppm if clock else float("nan")

    def _run(self) -> None:
        try:
            self._keep_reading()
        except Exception as error:  # noqa: BLE001 - whoever waits for frames must hear of it, or would wait for ever
            self._ring.put(ReaderFailed(error))

    def _keep_reading(self) -> None:
        backoff_s = _BACKOFF_FIRST_S
        while not self._stop.is_set():
            wait_s = 0.0
            try:
                link = open_serial(self._target) if isinstance(self._target, SerialLink) else open_tcp(self._target)
            except LinkUnavailableError as error:
                self._say("waiting", str(error))
            else:
                try:
                    if self._serve(link):
                        backoff_s = _BACKOFF_FIRST_S
                except BoardRefusedError as error:
                    self._say("refused", str(error))
                    self._ring.put(error.refused)
                    wait_s = _REFUSED_S
                finally:
                    link.close()
            self._stop.wait(wait_s or backoff_s * random.uniform(0.75, 1.25))
            backoff_s = min(2 * backoff_s, _BACKOFF_CAP_S)

    def _serve(self, link: Link) -> bool:
        """Talk to the board until the link is lost; return whether it ever counted."""
        connection = Connection(link, self._plate, self._numbering, self._ring, self._account, self._say)
        with self._lock:
            self._connection = connection
            self._account.connections += 1
        try:
            while not self._stop.is_set():
                connection.tend()
                data = link.read(_POLL_S)
                with self._lock:
                    connection.receive(data)
            connection.say_goodbye()
        except LinkLostError as error:
            if self._state.state != "stalled":
                self._say("lost" if connection.was_online else "waiting", str(error))
        finally:
            with self._lock:
                connection.close()
                self._connection = None
        return connection.was_online

    def _say(self, state: str, reason: str) -> None:
        if (state, reason) == (self._state.state, self._state.reason):
            return
        if state != self._state.state:
            log.log(logging.INFO if state in ("starting", "online") else logging.WARNING, "link %s: %s", state, reason)
        since = self._state.since_utc_ns if state == self._state.state else time.time_ns()
        self._state = LinkChange(state, reason, since)
        self._ring.put(self._state)
