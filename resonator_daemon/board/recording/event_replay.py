"""Replay of recorded link events, and detection of differences from what followed when they were recorded."""

import logging
import os
import time
from collections.abc import Callable

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.links.link import LinkLostError
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.recording.reader import Recording, open_recording
from resonator_daemon.board.session import board_reader
from resonator_daemon.board.session import link_events as wire
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.compatibility import BoardRefusedError
from resonator_daemon.board.session.link_state import all_of
from resonator_daemon.board.session.link_state_machine import LinkStateMachine

log = logging.getLogger(__name__)

_AT_ONCE_S = 1e-3  # a wait takes longer than this


def replay_of(link: LinkTarget, plate: Plate) -> board_reader.Replay | None:
    """Return what replays the recording that a link names, at its own speed; None where the link is a board's."""
    path = link.recording_path
    if path is None:
        return None

    def run(machine: LinkStateMachine, wait: Callable[[float], object], stopped: Callable[[], bool]) -> None:
        ahead_ns: int | None = None  # of recorded time before the present
        with open_recording(path, plate) as recording:
            replay = Replay(recording, machine)
            for event in recording.events():
                if ahead_ns is None:
                    ahead_ns = time.monotonic_ns() - event.now.monotonic_ns
                while (left_s := (event.now.monotonic_ns + ahead_ns - time.monotonic_ns()) * 1e-9) >= _AT_ONCE_S:
                    if stopped():
                        break
                    wait(left_s)
                if stopped():
                    replay.close(event.now)
                    return
                replay.apply(event)
            replay.end()

    return run


class Replay:
    """Applies the events of a recording, and compares what the connection does with what it did.

    Parameters
    ----------
    recording
        Whose events are handed to `apply`, in order.
    machine
        Has no link open.

    Attributes
    ----------
    differences
        How often what followed was not what is recorded; 0 where nothing of the recording is missing.
    """

    def __init__(self, recording: Recording, machine: LinkStateMachine) -> None:
        self._recording = recording
        self._machine = machine
        self._raised: BoardRefusedError | LinkLostError | None = None
        self._begun: HostTime | None = None
        self._now = HostTime(0, 0, 0)
        self._reading = False
        self._astray = True  # the state of the link is unknown
        self._first = ""
        self.differences = 0

    def apply(self, event: wire.WireEvent) -> None:
        if self._begun is None:
            self._begun = event.now
        self._now = event.now
        match event:
            case wire.Received() | wire.TimersRun() if self._raised is None and self._machine.connection is not None:
                # What of all events nearly every one is. It was sent before the link was read again; one reading may
                # have come in pieces.
                if event.idle if isinstance(event, wire.TimersRun) else not self._reading:
                    self._compare_sent(event, b"")
                self._reading = isinstance(event, wire.Received)
                self._apply(event)
            case wire.StateAnnounced() | wire.Skipped() | wire.ControlRequested():
                self._apply(event)
                if isinstance(event, wire.Skipped):
                    self._astray = True
                    self._differ(event, f"{event.events} events with {event.size_bytes} bytes are missing")
            case wire.SnapshotTaken():
                # Repeated for readers that have not read what was before.
                if self._astray and self._machine.connection is None:
                    self._apply(event)
                self._astray = False
            case wire.Opened():
                if self._machine.connection is not None:
                    self._differ(event, "the link is opened twice")
                    self.close(event.now)
                self._machine.apply(event)
            case _ if self._machine.connection is None:
                self._differ(event, "the link is not open")
            case wire.Lost() | wire.Refused():
                self._compare_end(event)
                self._machine.apply(event)
            case wire.Closed():
                self.close(event.now)
            case _ if self._raised is not None:
                self._differ(event, f"the link would have been closed: {self._raised}")
            case wire.Sent():
                self._apply(event)
                self._compare_sent(event, event.data)
            case wire.Overrun() | wire.StopRequested() | wire.BlinkRequested():
                self._reading = False
                self._apply(event)

    def _apply(self, event: wire.WireEvent) -> None:
        try:
            self._machine.apply(event)
        except (BoardRefusedError, LinkLostError) as error:
            self._raised = error
        except ValueError as error:  # no daemon has events in such an order; another program may
            self._differ(event, f"it cannot follow: {error}")

    def end(self) -> wire.WireEvent:
        """Announce that the link is lost because the recording is over; return that event."""
        self.close(self._now)
        name, damage = os.path.basename(self._recording.path), self._recording.damage
        sentences = [f"the recording {name} is over"]
        if damage is not None:
            sentences.append(f"its file is {damage}; all before that was replayed")
        if self.differences:
            sentences.append(f"replay differs from it in {self.differences} places, first {self._first}")
        reason = Reason(ReasonCode.RECORDING_OVER, "; ".join(sentences))
        over = wire.StateAnnounced(self._now, Condition.LOST, reason)
        self._machine.apply(over)
        return over

    def close(self, now: HostTime) -> None:
        """Close what is open."""
        self._raised = None
        if self._machine.connection is not None:
            self._machine.apply(wire.Closed(now))

    def _compare_sent(self, event: wire.WireEvent, sent: bytes) -> None:
        connection = self._machine.connection
        if connection is None or connection.pings.follow:
            return
        wanted = connection.session.data_to_send()
        if wanted != sent:
            self._differ(event, f"{sent.hex(' ') or 'nothing'} was sent, now {wanted.hex(' ') or 'nothing'} is")

    def _compare_end(self, event: wire.Lost | wire.Refused) -> None:
        raised, self._raised = self._raised, None
        match event, raised:
            case (wire.Lost(), None):
                return  # the link itself went away
            case (wire.Lost(), LinkLostError()):
                as_recorded = _same_codes((event.reason,), (raised.reason,))
            case (wire.Refused(), BoardRefusedError()):
                same_protocol = raised.refused.other_protocol == event.other_protocol
                as_recorded = same_protocol and _same_codes(event.problems, raised.refused.problems)
            case _:
                as_recorded = False
        if not as_recorded:
            now = raised or "nothing is wrong"
            reasons = (event.reason,) if isinstance(event, wire.Lost) else event.problems
            self._differ(event, f"the link was closed, {all_of(reasons).text}; now: {now}")

    def _differ(self, event: wire.WireEvent, what: str) -> None:
        self.differences += 1
        if self.differences == 1 and self._begun is not None:
            at_s = (event.now.monotonic_ns - self._begun.monotonic_ns) * 1e-9
            self._first = f"{at_s:.3f} s after its beginning: {what}"
            log.warning("replay differs from the recording %s, %s", self._recording.path, self._first)


def _same_codes(recorded: tuple[Reason, ...], present: tuple[Reason, ...]) -> bool:
    """Return whether the first codes are the same: old recordings have no codes, or those of further differences."""
    codes = [reason.code for reason in recorded]
    return ReasonCode.UNSPECIFIED in codes or codes[:1] == [reason.code for reason in present]
