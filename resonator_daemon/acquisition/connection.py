"""One opening of a link: the handshake with the board, its clock, its frames, and the timers that keep it going."""

import time
from collections.abc import Callable

from firmware_protocol.host import (
    Described,
    Frame,
    FramePart,
    HostEvent,
    HostSession,
    HostState,
    Pong,
    Rebooted,
    Started,
)
from firmware_protocol.layouts import PROTOCOL_MAJOR
from firmware_protocol.messages import BoardLog, BoardStatus, Configuration, Refusal
from firmware_protocol.packets import Damage, ForeignVersion
from resonator_daemon.acquisition.assembly import AssembledFrame, FrameAssembler
from resonator_daemon.acquisition.clock import BoardClock, Exchange
from resonator_daemon.acquisition.fit import gate_ticks, misfits
from resonator_daemon.acquisition.frames import (
    Arrival,
    BoardOnline,
    BoardRefused,
    BoardSays,
    ChannelisedFrame,
    LinkAccount,
    SingleToneFrame,
)
from resonator_daemon.acquisition.link import Link, LinkLostError
from resonator_daemon.acquisition.numbering import FrameNumbering
from resonator_daemon.acquisition.ring import Ring
from resonator_daemon.plate import Plate

_ASK_AGAIN_S = 0.3
_HANDSHAKE_S = 3.0
_PING_S = 0.97  # odd, so that it beats with nothing periodic
_FIRST_PINGS_S = 0.04
_FIRST_PINGS = 16
_SILENCE_FRAMES, _SILENCE_S = 3, 0.05
_REOPEN_S = 1.0
_FRAME_AGE_NS = 30_000_000_000  # far beyond what any buffer on the way can hold


class BoardRefusedError(Exception):
    """The board can never serve this plate, or speaks another protocol."""

    def __init__(self, refused: BoardRefused) -> None:
        super().__init__("; ".join(refused.problems))
        self.refused = refused


class Connection:
    """One opening of the link: a session, the board's clock, and the timers that keep both going."""

    def __init__(
        self,
        link: Link,
        plate: Plate,
        numbering: FrameNumbering,
        ring: Ring,
        account: LinkAccount,
        say: Callable[[str, str], None],
    ) -> None:
        self._link = link
        self._plate = plate
        self._numbering = numbering
        self._ring = ring
        self._account = account
        self._say = say
        self._single_tone = plate.counter.kind == "single-tone"
        self._session = HostSession()
        self._assembler = FrameAssembler(len(plate.tones.f0_hz))
        self._described: Described | None = None
        self._pings: dict[bytes, int] = {}
        self._pings_sent = 0
        self._silence_s = _SILENCE_FRAMES / plate.counter.frame_rate_hz + _SILENCE_S
        now = time.monotonic()
        self._opened = now
        self._last_frame = now
        self._next_ask = now + _ASK_AGAIN_S
        self._next_ping = now
        self.clock: BoardClock | None = None
        self.was_online = False

    def receive(self, data: bytes) -> None:
        """Take received bytes."""
        now_ns = time.monotonic_ns()
        for event in self._session.receive(data):
            self._handle(event, now_ns)
        self._flush()

    def tend(self) -> None:
        """Do what is due: ask again, ping, notice silence. Raises LinkLostError when the board must be opened anew."""
        now = time.monotonic()
        if self._session.state is HostState.RUNNING:
            self._watch_silence(now)
        elif now - self._opened > _HANDSHAKE_S:
            received = self._session.bytes.received
            heard = f"{received} bytes came and no answer" if received else "not a byte came"
            self._say("stalled", f"no board answers: {heard}; is it a board of this kind, and the baud rate right?")
            raise LinkLostError("no board answers")
        elif now >= self._next_ask:
            self._session.ask_again()
            self._next_ask = now + _ASK_AGAIN_S
        if self.clock is not None and now >= self._next_ping:
            self._ping(now)
        self._flush()

    def say_goodbye(self) -> None:
        """Stop the board, so that it does not fill a buffer that nobody empties."""
        self._session.stop()
        self._flush()

    def close(self) -> None:
        """Hand on what was begun and close the books of this connection."""
        for frame in self._assembler.flush():
            self._frame(frame)
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
        account.messages_unknown += session.messages.unknown + self._assembler.misfits

    def _flush(self) -> None:
        if data := self._session.data_to_send():
            self._link.write(data)

    def _handle(self, event: HostEvent, now_ns: int) -> None:
        match event:
            case Frame() if self._single_tone:
                self._frame(event)
            case FramePart() if not self._single_tone:
                for frame in self._assembler.add(event):
                    self._frame(frame)
            case Frame() | FramePart():
                self._account.messages_malformed += 1  # of the other kind of counter
            case Pong():
                self._pong(event, now_ns)
            case Described():
                self._describe(event)
            case Started():
                self._start(event)
            case Damage():
                self._numbering.discarded(event.size_bytes)
            case BoardStatus():
                self._numbering.dropped_by_board(event.frames_dropped)
            case BoardLog():
                self._ring.put(BoardSays(event.level, event.text))
            case Rebooted():
                for frame in self._assembler.flush():  # it belongs to the boot, and the clock, before
                    self._frame(frame)
                self._say("lost", "the board started anew")
                self.clock = None
                self._opened = time.monotonic()
            case Refusal():
                raise BoardRefusedError(BoardRefused((f"the board refuses the configuration: {event.text}",)))
            case ForeignVersion():
                problem = f"the board speaks protocol {event.major}, this daemon speaks {PROTOCOL_MAJOR}"
                raise BoardRefusedError(BoardRefused((problem,), other_protocol=True))

    def _describe(self, event: Described) -> None:
        if problems := misfits(event.description, self._plate):
            raise BoardRefusedError(BoardRefused(problems))
        board = f"board {event.identity.serial_number}"
        self._say("starting", f"{board} with firmware {event.identity.firmware} is being configured")
        self._described = event
        self._pings.clear()
        self._pings_sent = 0
        self.clock = BoardClock(event.description.reference_millihertz)
        self._ping(time.monotonic())

    def _start(self, event: Started) -> None:
        if self._described is None:  # the session starts only what it has described
            return
        asked, given = gate_ticks(self._plate), event.configuration.gate_ticks
        if given != asked:
            self.say_goodbye()
            problem = f"the board counts gates of {given} ticks, {asked} were asked for"
            raise BoardRefusedError(BoardRefused((problem,)))
        self._numbering.started()
        self.was_online = True
        self._last_frame = time.monotonic()
        self._ring.put(BoardOnline(*self._described, event.configuration))
        self._say_online()

    def _say_online(self) -> None:
        if self._described is not None:
            identity = self._described.identity
            rate_hz = self._plate.counter.frame_rate_hz
            self._say("online", f"board {identity.serial_number} sends {rate_hz:g} frames/s")

    def _ping(self, now: float) -> None:
        number = self._pings_sent.to_bytes(8, "little")
        self._pings_sent += 1
        self._next_ping = now + (_FIRST_PINGS_S if self._pings_sent < _FIRST_PINGS else _PING_S)
        self._session.ping(number)
        self._pings[number] = time.monotonic_ns()
        self._flush()

    def _pong(self, event: Pong, now_ns: int) -> None:
        sent_ns = self._pings.pop(event.opaque, None)
        if sent_ns is None or self.clock is None:
            return
        self._pings.clear()  # an answer that comes after a later one tells nothing
        utc_less_monotonic_ns = time.time_ns() - time.monotonic_ns()
        self.clock.add(Exchange(sent_ns, event.board_ticks, now_ns), utc_less_monotonic_ns)
        # Only now: every frame can be stamped from the first one on.
        if self._session.state is HostState.DESCRIBED:
            self._session.configure(Configuration(gate_ticks(self._plate)))

    def _frame(self, frame: Frame | AssembledFrame) -> None:
        if self.clock is None or self._described is None:
            return
        gate_end = self.clock.at(frame.board_ticks)
        age_ns = time.monotonic_ns() - (gate_end.utc_ns - self.clock.utc_less_monotonic_ns)
        if not -_FRAME_AGE_NS < age_ns < _FRAME_AGE_NS:
            self._account.messages_malformed += 1  # ticks that this boot has not reached, or long left behind
            return
        accepted = self._numbering.accept(self._described.boot_id, frame.sequence, frame.board_ticks, gate_end)
        if accepted is None:
            self._account.messages_stale += 1
            return
        index, gap = accepted
        self._last_frame = time.monotonic()
        self._account.frames += 1
        if gap is not None:
            self._account.lost = self._account.lost + gap.loss
            self._ring.put(gap)
        if isinstance(frame, Frame):
            arrival: Arrival = SingleToneFrame(index, frame.board_ticks, gate_end, frame.records)
        else:
            self._account.parts_lost += frame.parts - frame.parts_seen
            self._account.frames_incomplete += frame.parts_seen < frame.parts
            arrival = ChannelisedFrame(
                index,
                frame.board_ticks,
                gate_end,
                frame.phase_turn32,
                frame.offset_hz16,
                frame.sigma_code,
                frame.known,
            )
        self._ring.put(arrival, frame.size_bytes)

    def _watch_silence(self, now: float) -> None:
        silent_s = now - self._last_frame
        if silent_s > self._silence_s + _REOPEN_S:
            raise LinkLostError(f"the board was silent for {silent_s:.1f} s")
        if silent_s > self._silence_s:
            self._say("stalled", "the port is open and no frame comes")
        else:
            self._say_online()
