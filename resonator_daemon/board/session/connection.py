"""One opening of a link: the handshake with the board, its clock, its frames, and the timers that keep it going."""

from collections.abc import Sequence
from itertools import groupby
from typing import cast

from firmware_protocol.host import Described, Frame, FramePart, HostEvent, HostSession, Located, Pong, Rebooted, Started
from firmware_protocol.layouts import PROTOCOL_MAJOR
from firmware_protocol.messages import BoardLog, BoardStatus, Configuration, Refusal, RefusalCode
from firmware_protocol.packets import Damage, ForeignVersion
from firmware_protocol.states import HostState
from resonator_daemon.base.host.load import NO_LOAD, HostLoad, LoadSample
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.links.link import LinkLostError
from resonator_daemon.board.session import link_state
from resonator_daemon.board.session.board_reports import RESET_CAUSES, BlinkRequests, BoardLogFilter
from resonator_daemon.board.session.clock import BoardClock, Exchange, HostTime
from resonator_daemon.board.session.compatibility import (
    BoardRefusedError,
    first_of,
    gate_ticks,
    identity_changes,
    incompatibilities,
    tick_rate_problem,
    wrong_unit,
)
from resonator_daemon.board.session.frame_numbers import Accepted, FrameNumbering
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frame_receiver import AssembledFrame, FrameReceiver
from resonator_daemon.board.session.frames import BoardOnline, FrameLoss, LinkCounters
from resonator_daemon.board.session.link_events import ConnectionSnapshot
from resonator_daemon.board.session.link_state import UNANSWERED_S, LinkState, RefusalWatch
from resonator_daemon.board.session.pings import Pings

_MS = 1_000_000
_S = 1_000_000_000
_ASK_AGAIN_NS = 300 * _MS
_SILENCE_FRAMES, _SILENCE_NS = 3, 50 * _MS
_GIVE_UP_NS = 3 * _S  # from when a board is first asked, or called silent, until the link is opened again
_STUCK_NS = 500 * _MS  # of bytes without a frame, or of silence while programs wait for processors
_SLEPT_NS = 50 * _MS
_UNANSWERED_NS = UNANSWERED_S * _S


class Connection:
    """One opening of the link: a session, the board's clock, and the timers that keep both going.

    It reads no clock and opens nothing: bytes and times come as arguments, and its session has `data_to_send`.

    Parameters
    ----------
    known
        The board that was here before, None where none was: no other one is taken in its place.

    Attributes
    ----------
    session
        Bytes to events, requests to bytes.
    pings
        Pings on their way.
    load
        Load of the host.
    """

    def __init__(
        self,
        plate: Plate,
        known: Described | None,
        numbering: FrameNumbering,
        queue: FrameQueue,
        counters: LinkCounters,
        state: LinkState,
        opened: HostTime,
    ) -> None:
        self._plate = plate
        self._known = known
        self._numbering = numbering
        self._queue = queue
        self._counters = counters
        self._state = state
        self._gate_ticks = gate_ticks(plate)
        self.session = HostSession()
        self._receiver = FrameReceiver(plate, numbering, queue, counters, self.session.refuse)
        self._refusals = RefusalWatch(self.session.refusals, opened.monotonic_ns)
        self.pings = Pings()
        self._blink = BlinkRequests(queue)
        self._log_lines = BoardLogFilter(queue, counters)
        self._silence_ns = _SILENCE_FRAMES * round(_S / plate.counter.frame_rate_hz) + _SILENCE_NS
        self._silent_ns = 0  # since the last frame, without the time in which programs waited for processors
        self._now = opened
        self.load = HostLoad(opened.monotonic_ns)
        self._opened_ns = opened.monotonic_ns
        self._next_ask_ns = opened.monotonic_ns + _ASK_AGAIN_NS
        self._next_ping_ns = 0
        self._counting = False
        self._answered_ns = opened.monotonic_ns
        self._asleep_ns = opened.boottime_less_monotonic_ns
        self._rate_doubt: str | None = None  # what is odd about the board's ticks, though it can be read
        self._unanswered = False  # it does not answer, though it sends
        self._damaged_bytes = 0
        self.described: Described | None = None
        self.clock: BoardClock | None = None
        self.was_online = False

    def receive(self, data: bytes, now: HostTime) -> None:
        """Process bytes that had been received at `now`.

        Raises
        ------
        BoardRefusedError
            The board can never serve the plate.
        LinkLostError
            The board is not what it was: it must be asked again.
        """
        self._now = now
        for kind, group in groupby(self.session.receive(data), type):
            if kind is Frame:
                self._receive_frames(cast(list[Frame], list(group)))
            elif kind is FramePart:
                self._receive_frames(self._receiver.assemble(cast(list[FramePart], list(group))))
            else:
                for event in group:
                    self._handle(event)

    def snapshot(self) -> ConnectionSnapshot | None:
        """Return the state; None where a replay could not go on from it, as within a packet."""
        session = self.session
        damage = self._damaged_bytes != session.bytes.discarded
        underway = session.waiting_bytes or self._receiver.assembler.has_partial_frame or damage
        if self.described is None or not self._counting or underway or session.state is not HostState.RUNNING:
            return None
        clock = self.clock.snapshot() if self.clock is not None else None
        if clock is None or not self._state.online or not self._numbering.settled:
            return None
        return ConnectionSnapshot(
            self.described,
            session.configuration,
            session.number,
            self._answered_ns,
            self._rate_doubt,
            self._receiver.newest_ticks,
            clock,
            self.pings.snapshot(),
            self.load,
        )

    def restore(self, snapshot: ConnectionSnapshot) -> None:
        """Go on in a replay where the recorded connection was; it made the pings, and `sent` reports them."""
        described = self.described = snapshot.described
        self.pings.restore(snapshot.pings)
        self.session.restore(described, snapshot.configuration, snapshot.request_number)
        self.clock = BoardClock(described.description.reference_millihertz)
        self.clock.restore(snapshot.clock)
        self._receiver.newest_ticks = snapshot.newest_ticks
        self._answered_ns = snapshot.answered_ns
        self.load = snapshot.load
        self._rate_doubt = snapshot.rate_doubt
        self._unanswered = self._now.monotonic_ns - self._answered_ns > _UNANSWERED_NS
        self._receiver.last_frame_ns = self._now.monotonic_ns
        self._counting = self.was_online = True
        self._counters.boot(described.boot_id).connections += 1
        self._queue.put(BoardOnline(*described, snapshot.configuration, continues=False))

    def sent(self, data: bytes, now: HostTime) -> None:
        """Follow what the recorded connection has sent."""
        self.pings.sent(self.session, data, now, self._receiver.newest_ticks)

    def blink(self, now: HostTime) -> None:
        """Ask the board to blink; BlinkAnswered follows in any case."""
        self._blink.ask(self.session, now.monotonic_ns)

    def overrun(self) -> None:
        """Count a loss of bytes by the host's driver."""
        self._counters.host_overruns += 1
        self._numbering.overrun()

    def run_timers(self, now: HostTime, *, idle: bool, sample: LoadSample = NO_LOAD) -> None:
        """Do what is due: ask again, ping, notice silence; `idle`: nothing is left to read.

        Raises
        ------
        LinkLostError
            When the board must be opened again.
        """
        self._now = now
        now_ns = now.monotonic_ns
        load_changed = self._update_load(now_ns, sample)
        if now.boottime_less_monotonic_ns - self._asleep_ns > _SLEPT_NS:
            self._next_ping_ns = now_ns  # the host has slept: what it knew of the board's clock is void
        self._asleep_ns = now.boottime_less_monotonic_ns
        if self._counting:
            # A reader that comes late finds much to read, and the frames in it: that is no silence.
            if idle or now_ns - self._receiver.last_frame_ns > self._silence_ns + _STUCK_NS:
                self._watch_silence(now_ns)
            if now_ns - self._answered_ns > _UNANSWERED_NS and not self._unanswered and self._state.online:
                self._unanswered = True
                self._announce_online()
        elif now_ns - self._opened_ns > _GIVE_UP_NS:
            self._announce(Condition.STALLED, self._silence())
            raise LinkLostError(ReasonCode.NO_BOARD_ANSWERS, "no board answers")
        if self._refusals.update(now_ns) or load_changed:
            if self._state.online:
                self._announce_online()
            elif self._counting and self._state.state is Condition.STALLED:
                self._announce(Condition.STALLED, self._no_frame())
        if not self.session.awaits_answer:
            self._next_ask_ns = now_ns + _ASK_AGAIN_NS
        elif now_ns >= self._next_ask_ns:
            self.session.ask_again()
            self._next_ask_ns = now_ns + _ASK_AGAIN_NS
        if self._blink.due_ns is not None:
            self._blink.run_timers(self.session, now_ns)  # after what takes all unanswered requests for lost
        if self.clock is not None and now_ns >= self._next_ping_ns:
            self._ping(self.clock)

    def due_ns(self) -> int:
        """Return the monotonic time at which `run_timers` has something to do."""
        due_ns = self._next_ask_ns
        if self._blink.due_ns is not None:
            due_ns = min(due_ns, self._blink.due_ns)
        if self.clock is not None:
            due_ns = min(due_ns, self._next_ping_ns)
        if self._counting:
            noticed_ns = self._receiver.last_frame_ns + self._silence_ns + 1
            if self._state.state is Condition.STALLED:
                noticed_ns += _GIVE_UP_NS
            elif self._receiver.last_frame_ns < self.load.monotonic_ns:
                noticed_ns = self.load.monotonic_ns + max(self._silence_ns - self._silent_ns, _MS) + 1
            due_ns = min(due_ns, noticed_ns)
        return due_ns

    def close(self) -> None:
        """Pass on what was begun, and add the counts of this connection to the link's."""
        self._flush_receiver()
        self._blink.close()
        self.add_to(self._counters)
        self._counters.bytes_discarded += self._counters.bytes_waiting
        self._counters.bytes_waiting = 0

    def add_to(self, counters: LinkCounters) -> None:
        """Add this connection's counts."""
        session = self.session
        counters.bytes_received += session.bytes.received
        counters.bytes_accepted += session.bytes.accepted
        counters.bytes_other_version += session.bytes.other_version
        counters.bytes_echo += session.bytes.echo
        counters.bytes_discarded += session.bytes.discarded
        counters.bytes_waiting += session.waiting_bytes
        counters.messages_stale += session.messages.stale
        counters.messages_malformed += session.messages.malformed
        counters.refusals.update(session.refusals)
        counters.messages_unknown += session.messages.unknown + self._receiver.assembler.unplaced_parts
        self._add_clock_to(counters)

    def _add_clock_to(self, counters: LinkCounters) -> None:
        if (clock := self.clock) is not None:
            counters.clock_outliers += clock.outliers
            counters.clock_restarts += clock.restarts

    def _silence(self) -> Reason:
        """Return why the handshake came to no end."""
        lacks_pong = self.described is not None and self.session.state is HostState.DESCRIBED
        return link_state.silence(
            self.session.bytes.received,
            self.session.most_refused,
            self.described.identity.serial_number if self.described is not None and lacks_pong else None,
        )

    def _announce(self, state: Condition, reason: Reason) -> None:
        self._state.announce(state, reason, self._now.utc_ns)

    def _handle(self, event: HostEvent) -> None:
        match event:
            case Pong():
                if self.session.state is HostState.RUNNING:  # else a request of the handshake may be lost all the same
                    self._next_ask_ns = self._now.monotonic_ns + _ASK_AGAIN_NS
                self._pong(event)
            case Described():
                self._next_ask_ns = self._now.monotonic_ns + _ASK_AGAIN_NS
                self._describe(event)
            case Started():
                self._start(event)
            case Located():
                self._blink.answered(event)
            case Damage():
                self._damaged_bytes += event.size_bytes
                self._numbering.discarded(event.size_bytes)
            case BoardStatus():
                self._numbering.dropped_by_board(event.frames_dropped)
            case BoardLog():
                self._log_lines.put(event, self._now.monotonic_ns)
            case Rebooted():
                self._rebooted()
            case Refusal():
                self._refused(event)
            case ForeignVersion():
                problem = f"the board uses protocol {event.major}, this daemon uses {PROTOCOL_MAJOR}"
                raise BoardRefusedError(Reason(ReasonCode.WRONG_PROTOCOL, problem), other_protocol=True)

    def _receive_frames(self, frames: Sequence[Frame | AssembledFrame]) -> None:
        if not frames or self.clock is None or self.described is None:
            return
        boot_id, scale = self.described.boot_id, self.clock.scale
        while frames and self._state.state is not Condition.ONLINE:  # which is announced after the first frame
            self._note_frames(self._receiver.receive(frames[:1], scale, boot_id, self._now, singly=True))
            frames = frames[1:]
        if frames and (begun := self._receiver.receive(frames, scale, boot_id, self._now)):
            self._note_frames(begun)

    def _flush_receiver(self) -> None:
        if self._receiver.assembler.has_partial_frame and self.clock is not None and self.described is not None:
            self._note_frames(self._receiver.flush(self.clock.scale, self.described.boot_id, self._now))

    def _rebooted(self) -> None:
        self._flush_receiver()  # what it holds belongs to the boot, and the clock, before
        self._announce(Condition.LOST, link_state.restarted())
        self._add_clock_to(self._counters)
        self.clock = None
        if self._counting:  # a board that does nothing but restart has the time of one handshake
            self._opened_ns = self._now.monotonic_ns
        self._counting = False
        self._next_ask_ns = self._now.monotonic_ns + _ASK_AGAIN_NS

    def _refused(self, refusal: Refusal) -> None:
        match refusal.code:
            case RefusalCode.NOT_IN_THIS_STATE if self._counting:
                raise LinkLostError(
                    ReasonCode.CONFIGURATION_LOST, f"the board has lost its configuration ({refusal.text})"
                )
            case RefusalCode.FAULT:
                fault = Reason(ReasonCode.BOARD_FAULT, f"the board cannot count: {refusal.text}")
                self._announce(Condition.STALLED, fault)
                raise LinkLostError(ReasonCode.BOARD_FAULT, refusal.text)
            case RefusalCode.OTHER_VERSION:
                problem = Reason(ReasonCode.WRONG_PROTOCOL, f"the board does not support protocol {PROTOCOL_MAJOR}")
                raise BoardRefusedError(problem, other_protocol=True)
            case _:
                words = f"the board refuses the configuration: {refusal.text}"
                raise BoardRefusedError(Reason(ReasonCode.CONFIGURATION_REFUSED, words))

    def _describe(self, event: Described) -> None:
        problems = incompatibilities(event.description, self._plate)
        if problems:
            raise BoardRefusedError(first_of(problems))
        if self._known is not None and (changes := identity_changes(event, self._known)):
            raise BoardRefusedError(first_of(changes))
        unit = self._plate.calibration.unit
        if self._known is None and unit and unit != event.identity.serial_number:
            raise BoardRefusedError(wrong_unit(event.identity.serial_number, unit))
        identity = event.identity
        before = self.described or self._known
        if before is not None and before.boot_id != event.boot_id:
            self._announce(Condition.LOST, link_state.restarted(RESET_CAUSES.get(identity.reset_cause, "")))
        self._announce(Condition.STARTING, link_state.configuring(identity.serial_number, identity.firmware))
        self.described = event
        self.pings.restart()
        self._receiver.newest_ticks = 0
        self.clock = BoardClock(event.description.reference_millihertz)
        self._ping(self.clock)

    def _start(self, event: Started) -> None:
        if self.described is None or self.clock is None or self._counting:
            return  # the answer of a board that was asked to go on
        given = event.configuration.gate_ticks
        if given != self._gate_ticks:
            words = f"the board acquires gates of {given} ticks instead of {self._gate_ticks}"
            raise BoardRefusedError(Reason(ReasonCode.WRONG_GATE, words))
        continues = self._numbering.continues(self.described.boot_id, self._receiver.newest_ticks)
        self._numbering.started(self._now.monotonic_ns)
        self._counting = True
        self._receiver.last_frame_ns = self._answered_ns = self._now.monotonic_ns
        self._counters.boot(self.described.boot_id).connections += 1
        self._queue.put(BoardOnline(*self.described, event.configuration, continues))

    def _announce_online(self) -> None:
        if self.described is not None:
            reason = link_state.counting(
                self.described.identity.serial_number,
                self._plate.counter.frame_rate_hz,
                rate_doubt=self._rate_doubt,
                is_unanswered=self._unanswered,
                refused=self._refusals.most_frequent,
                busy=self.load.busy,
            )
            self._announce(Condition.ONLINE, reason)

    def _ping(self, clock: BoardClock) -> None:
        now_ns = self._now.monotonic_ns
        self.pings.make(self.session, now_ns, self._receiver.newest_ticks)
        self._next_ping_ns = clock.ping_due_ns(now_ns)

    def _pong(self, event: Pong) -> None:
        ping = self.pings.answered(event.opaque)
        if ping is None or self.clock is None or self.described is None:
            return
        if event.board_ticks < ping.known_ticks:
            raise LinkLostError(
                ReasonCode.CLOCK_JUMPED,
                f"boot id {self.described.boot_id:08x} came twice: the board's ticks went back from "
                f"{ping.known_ticks} to {event.board_ticks}, as at a start",
            )
        self._receiver.newest_ticks = max(self._receiver.newest_ticks, event.board_ticks)
        now = self._now
        self._answered_ns = now.monotonic_ns
        exchange = Exchange(ping.sent_ns, event.board_ticks, now.monotonic_ns)
        self.clock.add(exchange, now.utc_less_monotonic_ns, boottime_less_monotonic_ns=now.boottime_less_monotonic_ns)
        if not self._rate_doubt and (measured := self.clock.rate_beyond_tolerance) is not None:
            # Flagged, not refused: tones far from where they should be are rejected when sites are identified.
            self._rate_doubt = tick_rate_problem(self.described.description, *measured)
        self._unanswered = False
        if self._state.online:
            self._announce_online()
        self._next_ping_ns = min(self._next_ping_ns, self.clock.ping_due_ns(now.monotonic_ns))
        # Only now: every frame can be stamped from the first one on.
        if self.session.state is HostState.DESCRIBED:
            self.session.configure(Configuration(self._gate_ticks))
        elif self._state.state is Condition.STALLED:
            self.session.resume()

    def _note_frames(self, begun: Sequence[Accepted]) -> None:
        for accepted in begun:
            self.was_online = True
            if not self._state.online:
                self._announce_online()
            loss = accepted.gap.loss if accepted.gap else FrameLoss()
            in_outage = self._state.frame_received(accepted.previous, accepted.middle, loss.total)
            if accepted.gap:
                boot = self._counters.boots[-1]
                in_outages = boot.lost_in_outages + loss if in_outage else boot.lost_in_outages
                boot.lost_in_outages = in_outages.within(boot.lost)

    def _update_load(self, now_ns: int, sample: LoadSample) -> bool:
        """Update the load of the host, and the silence; return whether the reason of a busy computer has changed."""
        before, last_frame_ns = self.load, self._receiver.last_frame_ns
        if last_frame_ns >= before.monotonic_ns:
            self._silent_ns = 0
        silent_ns = now_ns - max(last_frame_ns, before.monotonic_ns)
        self._silent_ns += silent_ns * (100 - sample.pressure_percent) // 100
        self.load = before.updated(now_ns, sample)
        return before.busy != self.load.busy

    def _no_frame(self) -> Reason:
        return link_state.no_frame(self._refusals.most_frequent, self.load.busy)

    def _watch_silence(self, now_ns: int) -> None:
        silent_ns = now_ns - self._receiver.last_frame_ns
        if silent_ns > self._silence_ns + _GIVE_UP_NS:
            raise LinkLostError(ReasonCode.BOARD_SILENT, f"the board was silent for {silent_ns * 1e-9:.1f} s")
        is_silent = self._silent_ns > self._silence_ns or silent_ns > self._silence_ns + _STUCK_NS
        if is_silent and self._state.state is not Condition.STALLED:
            self._announce(Condition.STALLED, self._no_frame())
            self._next_ping_ns = now_ns  # whether it is alive at all: if so it is asked to go on
