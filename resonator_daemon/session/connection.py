"""One opening of a link: the handshake with the board, its clock, its frames, and the timers that keep it going."""

from itertools import groupby

from firmware_protocol.host import Described, Frame, FramePart, HostEvent, HostSession, Located, Pong, Rebooted, Started
from firmware_protocol.layouts import PROTOCOL_MAJOR
from firmware_protocol.messages import BoardLog, BoardStatus, Configuration, Refusal, RefusalCode
from firmware_protocol.packets import Damage, ForeignVersion
from firmware_protocol.states import HostState
from resonator_daemon.links.link import LinkLostError
from resonator_daemon.plate import Plate
from resonator_daemon.session.blink import Locating
from resonator_daemon.session.board_log import LogLines, after
from resonator_daemon.session.clock import BoardClock, Exchange, Instant
from resonator_daemon.session.compatibility import BoardRefusedError, gate_ticks, measured_misfit, misfits, strangers
from resonator_daemon.session.counters import LinkAccount
from resonator_daemon.session.frame_numbers import Accepted, FrameNumbering
from resonator_daemon.session.frame_queue import Ring
from resonator_daemon.session.frame_receiver import FrameIntake
from resonator_daemon.session.frames import BoardOnline
from resonator_daemon.session.host_time import HostTime
from resonator_daemon.session.link_snapshot import Running
from resonator_daemon.session.link_state import LinkState
from resonator_daemon.session.pings import Pings

_MS = 1_000_000
_S = 1_000_000_000
_ASK_AGAIN_NS = 300 * _MS
_HANDSHAKE_NS = 3 * _S
_SILENCE_FRAMES, _SILENCE_NS = 3, 50 * _MS
_REOPEN_NS = 1 * _S  # of silence beyond what was noticed
_STUCK_NS = 500 * _MS  # of bytes without a frame among them
_SLEPT_NS = 50 * _MS
_DEAF_NS = 10 * _S  # without an answer, though frames come


class Connection:
    """One opening of the link: a session, the board's clock, and the timers that keep both going.

    It reads no clock and opens nothing: it is handed bytes and times, and has `data_to_send`.

    Parameters
    ----------
    known
        The board that was here before, None where none was: no other one is taken in its place.
    """

    def __init__(
        self,
        plate: Plate,
        known: Described | None,
        numbering: FrameNumbering,
        ring: Ring,
        account: LinkAccount,
        state: LinkState,
        opened: HostTime,
    ) -> None:
        self._plate = plate
        self._known = known
        self._numbering = numbering
        self._ring = ring
        self._account = account
        self._state = state
        self._gate_ticks = gate_ticks(plate)
        self._session = HostSession()
        self._intake = FrameIntake(plate, numbering, ring, account)
        self._pings = Pings()
        self._locating = Locating(ring)
        self._log_lines = LogLines(ring, account)
        self._silence_ns = _SILENCE_FRAMES * round(_S / plate.counter.frame_rate_hz) + _SILENCE_NS
        self._now = opened
        self._opened_ns = opened.monotonic_ns
        self._next_ask_ns = opened.monotonic_ns + _ASK_AGAIN_NS
        self._next_ping_ns = 0
        self._clock_counts = (0, 0)  # outliers and restarts of clocks that are gone
        self._counting = False
        self._answered_ns = opened.monotonic_ns
        self._asleep_ns = opened.boottime_less_monotonic_ns
        self._rate_doubt = ""  # what is odd about the board's ticks, though it can be read
        self._deaf = False  # it does not answer, though it sends
        self._damaged_bytes = 0
        self.described: Described | None = None
        self.clock: BoardClock | None = None
        self.was_online = False

    def receive(self, data: bytes, now: HostTime) -> None:
        """Take bytes that had been received at `now`.

        Raises
        ------
        BoardRefusedError
            The board can never serve the plate.
        LinkLostError
            The board is not what it was: it must be asked anew.
        """
        self._now = now
        for kind, events in groupby(self._session.receive(data), type):
            if kind is Frame:
                self._take_frames([event for event in events if isinstance(event, Frame)])
            elif kind is FramePart:
                self._take_parts([event for event in events if isinstance(event, FramePart)])
            else:
                for event in events:
                    self._handle(event)

    def data_to_send(self) -> bytes:
        """Return and clear the bytes that the board must get, at once."""
        return self._session.data_to_send()

    @property
    def awaits_answer(self) -> bool:
        """Whether a ping is on its way."""
        return self._pings.await_answer

    @property
    def within_packet(self) -> bool:
        """Whether the last bytes that were received end in the middle of a packet."""
        return self._session.waiting_bytes > 0

    @property
    def follows(self) -> bool:
        """Whether what went out is told by `sent` instead of made here."""
        return self._pings.follow

    def standing(self) -> Running | None:
        """Return what another connection needs to go on from here; None where it could not, as within a packet."""
        session = self._session
        underway = session.waiting_bytes or self._intake.frame_begun or self._damaged_bytes != session.bytes.discarded
        if self.described is None or not self._counting or underway or session.state is not HostState.RUNNING:
            return None
        clock = self.clock.standing if self.clock is not None else None
        if clock is None or self._state.state != "online" or not self._numbering.settled:
            return None
        return Running(
            self.described,
            session.configuration,
            session.number,
            self._answered_ns,
            self._rate_doubt,
            self._intake.newest_ticks,
            clock,
            self._pings.standing,
        )

    def join(self, running: Running) -> None:
        """Go on where another connection stood: it pings the board, and `sent` tells of that."""
        described = self.described = running.described
        self._pings.follow_another(running.pings)
        self._session = HostSession.running(described, running.configuration, running.request_number)
        self.clock = BoardClock.resumed(described.description.reference_millihertz, running.clock)
        self._intake.newest_ticks = running.newest_ticks
        self._answered_ns = running.answered_ns
        self._rate_doubt = running.rate_doubt
        self._deaf = self._now.monotonic_ns - self._answered_ns > _DEAF_NS
        self._intake.last_frame_ns = self._now.monotonic_ns
        self._counting = self.was_online = True
        self._account.boot(described.boot_id).connections += 1
        self._ring.put(BoardOnline(*described, running.configuration, continues=False))

    def sent(self, data: bytes, now: HostTime) -> None:
        """Take what the connection that is followed has sent."""
        self._pings.sent(self._session, data, now, self._intake.newest_ticks)

    def locate(self, now: HostTime) -> None:
        """Ask the board to make itself seen; BoardLocated follows in any case."""
        self._locating.ask(self._session, now.monotonic_ns)

    def overrun(self) -> None:
        """Take note that the host's driver lost bytes of this link."""
        self._account.host_overruns += 1
        self._numbering.overrun()

    def tend(self, now: HostTime, *, idle: bool) -> None:
        """Do what is due: ask again, ping, notice silence; `idle`: nothing is left to read.

        Raises
        ------
        LinkLostError
            When the board must be opened anew.
        """
        self._now = now
        now_ns = now.monotonic_ns
        if now.boottime_less_monotonic_ns - self._asleep_ns > _SLEPT_NS:
            self._next_ping_ns = now_ns  # the host has slept: what it knew of the board's clock is void
        self._asleep_ns = now.boottime_less_monotonic_ns
        if self._counting:
            # A reader that comes late finds much to read, and the frames in it: that is no silence.
            if idle or now_ns - self._intake.last_frame_ns > self._silence_ns + _STUCK_NS:
                self._watch_silence(now_ns)
            if now_ns - self._answered_ns > _DEAF_NS and not self._deaf and self._state.state == "online":
                self._deaf = True
                self._say_online()
        elif now_ns - self._opened_ns > _HANDSHAKE_NS:
            received = self._session.bytes.received
            heard = f"{received} bytes came and no answer" if received else "not a byte came"
            self._say("stalled", f"no board answers: {heard}; is it a board of this kind, and the baud rate right?")
            raise LinkLostError("no board answers")
        if not self._session.awaits_answer:
            self._next_ask_ns = now_ns + _ASK_AGAIN_NS
        elif now_ns >= self._next_ask_ns:
            self._session.ask_again()
            self._next_ask_ns = now_ns + _ASK_AGAIN_NS
        if self._locating.due_ns is not None:
            self._locating.tend(self._session, now_ns)  # after what takes all unanswered requests for lost
        if self.clock is not None and now_ns >= self._next_ping_ns:
            self._ping(self.clock)

    def due_ns(self) -> int:
        """Return the monotonic time at which `tend` has something to do."""
        dues = [self._next_ask_ns]
        if self._locating.due_ns is not None:
            dues.append(self._locating.due_ns)
        if self.clock is not None:
            dues.append(self._next_ping_ns)
        if self._counting:
            noticed_ns = self._intake.last_frame_ns + self._silence_ns + 1
            dues.append(noticed_ns + _REOPEN_NS if self._state.state == "stalled" else noticed_ns)
        return min(dues)

    def say_goodbye(self) -> None:
        """Stop the board, so that it does not fill a buffer that nobody empties."""
        self._session.stop()

    def close(self) -> None:
        """Hand on what was begun and close the books of this connection."""
        self._flush_intake()
        self._locating.close()
        self.add_to(self._account)
        self._account.bytes_discarded += self._account.bytes_waiting
        self._account.bytes_waiting = 0

    def add_to(self, account: LinkAccount) -> None:
        """Add this connection's counts."""
        session = self._session
        account.bytes_received += session.bytes.received
        account.bytes_accepted += session.bytes.accepted
        account.bytes_other_version += session.bytes.other_version
        account.bytes_own_direction += session.bytes.own_direction
        account.bytes_discarded += session.bytes.discarded
        account.bytes_waiting += session.waiting_bytes
        account.messages_stale += session.messages.stale
        account.messages_malformed += session.messages.malformed
        account.messages_unknown += session.messages.unknown + self._intake.misfits
        outliers, restarts = self._clock_counts
        clock = self.clock
        account.clock_outliers += outliers + (clock.outliers if clock else 0)
        account.clock_restarts += restarts + (clock.restarts if clock else 0)

    def _say(self, state: str, reason: str) -> None:
        self._state.say(state, reason, self._now.utc_ns)

    def _handle(self, event: HostEvent) -> None:
        match event:
            case Pong():
                if self._session.state is HostState.RUNNING:  # else a request of the handshake may be lost all the same
                    self._next_ask_ns = self._now.monotonic_ns + _ASK_AGAIN_NS
                self._pong(event)
            case Described():
                self._next_ask_ns = self._now.monotonic_ns + _ASK_AGAIN_NS
                self._describe(event)
            case Started():
                self._start(event)
            case Located():
                self._locating.take(event)
            case Damage():
                self._damaged_bytes += event.size_bytes
                self._numbering.discarded(event.size_bytes)
            case BoardStatus():
                self._numbering.dropped_by_board(event.frames_dropped)
            case BoardLog():
                self._log_lines.take(event, self._now.monotonic_ns)
            case Rebooted():
                self._rebooted()
            case Refusal():
                self._refused(event)
            case ForeignVersion():
                problem = f"the board speaks protocol {event.major}, this daemon speaks {PROTOCOL_MAJOR}"
                raise BoardRefusedError(problem, other_protocol=True)

    def _take_frames(self, frames: list[Frame]) -> None:
        if not frames or self.clock is None or self.described is None:
            return
        boot_id, start = self.described.boot_id, 0
        while start < len(frames) and self._state.state != "online":  # which is announced after the first frame
            self._frames_came(self._intake.take_frames(frames[start : start + 1], self.clock, boot_id, self._now))
            start += 1
        if start < len(frames):
            self._frames_came(self._intake.take_frames(frames[start:], self.clock, boot_id, self._now))

    def _take_parts(self, parts: list[FramePart]) -> None:
        if self.clock is None or self.described is None:
            return
        for frame in self._intake.assemble(parts):
            taken = self._intake.take_assembled(frame, self.clock.scale, self.described.boot_id, self._now)
            if taken is not None:
                self._frames_came([taken])

    def _flush_intake(self) -> None:
        if self.clock is not None and self.described is not None:
            self._frames_came(self._intake.flush(self.clock, self.described.boot_id, self._now))

    def _rebooted(self) -> None:
        self._flush_intake()  # what it holds belongs to the boot, and the clock, before
        self._say("lost", "the board started anew")
        if self.clock is not None:
            outliers, restarts = self._clock_counts
            self._clock_counts = (outliers + self.clock.outliers, restarts + self.clock.restarts)
        self.clock = None
        if self._counting:  # a board that does nothing but start anew has the time of one handshake
            self._opened_ns = self._now.monotonic_ns
        self._counting = False
        self._next_ask_ns = self._now.monotonic_ns + _ASK_AGAIN_NS

    def _refused(self, refusal: Refusal) -> None:
        match refusal.code:
            case RefusalCode.NOT_IN_THIS_STATE if self._counting:
                raise LinkLostError(f"the board has forgotten its configuration ({refusal.text})")
            case RefusalCode.FAULT:
                self._say("stalled", f"the board cannot count: {refusal.text}")
                raise LinkLostError(refusal.text)
            case RefusalCode.OTHER_VERSION:
                raise BoardRefusedError(f"the board does not speak protocol {PROTOCOL_MAJOR}", other_protocol=True)
            case _:
                raise BoardRefusedError(f"the board refuses the configuration: {refusal.text}")

    def _describe(self, event: Described) -> None:
        problems = misfits(event.description, self._plate)
        if self._known is not None:
            problems += strangers(event, self._known)
        elif (unit := self._plate.calibration.unit) and unit != event.identity.serial_number:
            problems += (
                f"serial number: the board is {event.identity.serial_number}, the plate file was calibrated with "
                f"{unit}; connect that one, or name the plate file of this one",
            )
        if problems:
            raise BoardRefusedError(*problems)
        identity = event.identity
        before = self.described or self._known
        if before is not None and before.boot_id != event.boot_id:
            self._say("lost", f"the board started anew{after(identity.reset_cause)}")
        self._say("starting", f"board {identity.serial_number} with firmware {identity.firmware} is being configured")
        self.described = event
        self._pings.restart()
        self._intake.newest_ticks = 0
        self.clock = BoardClock(event.description.reference_millihertz)
        self._ping(self.clock)

    def _start(self, event: Started) -> None:
        if self.described is None or self.clock is None or self._counting:
            return  # the answer of a board that was asked to go on
        given = event.configuration.gate_ticks
        if given != self._gate_ticks:
            raise BoardRefusedError(f"the board counts gates of {given} ticks, {self._gate_ticks} were asked for")
        continues = self._numbering.continues(self.described.boot_id, self._intake.newest_ticks)
        self._numbering.started(self._now.monotonic_ns)
        self._counting = True
        self._intake.last_frame_ns = self._answered_ns = self._now.monotonic_ns
        self._account.boot(self.described.boot_id).connections += 1
        self._ring.put(BoardOnline(*self.described, event.configuration, continues))

    def _say_online(self) -> None:
        if self.described is not None:
            rate_hz = self._plate.counter.frame_rate_hz
            told = [f"board {self.described.identity.serial_number} sends {rate_hz:g} frames/s"]
            if self._rate_doubt:
                told.append(self._rate_doubt)
            if self._deaf:
                told.append(f"no ping was answered for {_DEAF_NS // _S} s: is the line to the board broken?")
            self._say("online", "; ".join(told))

    def _ping(self, clock: BoardClock) -> None:
        now_ns = self._now.monotonic_ns
        self._pings.make(self._session, now_ns, self._intake.newest_ticks)
        self._next_ping_ns = clock.ping_due_ns(now_ns)

    def _pong(self, event: Pong) -> None:
        ping = self._pings.take(event.opaque)
        if ping is None or self.clock is None or self.described is None:
            return
        if event.board_ticks < ping.known_ticks:
            raise LinkLostError(
                f"boot id {self.described.boot_id:08x} came twice: the board's ticks went back from "
                f"{ping.known_ticks} to {event.board_ticks}, as at a start"
            )
        self._intake.newest_ticks = max(self._intake.newest_ticks, event.board_ticks)
        now = self._now
        self._answered_ns = now.monotonic_ns
        exchange = Exchange(ping.sent_ns, event.board_ticks, now.monotonic_ns)
        self.clock.add(exchange, now.utc_less_monotonic_ns, boottime_less_monotonic_ns=now.boottime_less_monotonic_ns)
        if not self._rate_doubt and (measured := self.clock.rate_beyond_tolerance) is not None:
            # Flagged, not refused: tones far from where they should be are rejected by whoever matches them.
            self._rate_doubt = measured_misfit(self.described.description, *measured)
        self._deaf = False
        if self._state.state == "online":
            self._say_online()
        self._next_ping_ns = min(self._next_ping_ns, self.clock.ping_due_ns(now.monotonic_ns))
        # Only now: every frame can be stamped from the first one on.
        if self._session.state is HostState.DESCRIBED:
            self._session.configure(Configuration(self._gate_ticks))
        elif self._state.state == "stalled":
            self._session.resume()

    def _frames_came(self, taken: list[tuple[Accepted, Instant]]) -> None:
        for accepted, middle in taken:
            self.was_online = True
            if self._state.state != "online":
                self._say_online()
            self._state.frame_came(accepted.previous, middle, accepted.gap.loss.total if accepted.gap else 0)

    def _watch_silence(self, now_ns: int) -> None:
        silent_ns = now_ns - self._intake.last_frame_ns
        if silent_ns > self._silence_ns + _REOPEN_NS:
            raise LinkLostError(f"the board was silent for {silent_ns * 1e-9:.1f} s")
        if silent_ns > self._silence_ns and self._state.state != "stalled":
            self._say("stalled", "the port is open and no frame comes")
            self._next_ping_ns = now_ns  # whether it is alive at all: if so it is asked to go on
