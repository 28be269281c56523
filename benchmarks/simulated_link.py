"""An emulated board and the daemon's end of its link in simulated time: bursts of frames, and skips between them."""

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from resonator_daemon.conditions import Condition
from resonator_daemon.links.link import LinkLostError
from resonator_daemon.plate import Plate
from resonator_daemon.reasons import Reason, ReasonCode
from resonator_daemon.session import link_events as wire
from resonator_daemon.session.counters import LinkCounters
from resonator_daemon.session.frame_queue import FrameQueue
from resonator_daemon.session.host_time import HostTime
from resonator_daemon.session.link_state_machine import LinkStateMachine
from simulators.emulator import _emulated_board
from simulators.faults.misbehaviour import Misbehaviour
from simulators.scenario import load_scenario

S: Final = 1_000_000_000
STEP_NS: Final = 20_000_000  # from one read of the link to the next
_DELAY_NS: Final = 20_000  # of bytes, each way
_UNPLUGGED: Final = Reason(ReasonCode.UNPLUGGED, "unplugged")


class SimulatedHost:
    """Clocks of a computer: `elapsed_ns` is true time; UTC is set, and the monotonic clock stops during suspend."""

    def __init__(self, utc_ns: int) -> None:
        self.elapsed_ns = 0
        self.slept_ns = 0
        self._utc_ns = utc_ns

    @property
    def utc_ns(self) -> int:
        return self._utc_ns + self.elapsed_ns

    def now(self, later_ns: int = 0) -> HostTime:
        monotonic_ns = self.elapsed_ns - self.slept_ns + later_ns
        return HostTime(monotonic_ns, self._utc_ns + self.slept_ns, self.slept_ns)

    def step_utc(self, step_ns: int) -> None:
        self._utc_ns += step_ns

    def sleep(self, duration_ns: int) -> None:
        self.elapsed_ns += duration_ns
        self.slept_ns += duration_ns


@dataclass
class Truth:
    """What the board and the link did since a daemon started."""

    delivered: int = 0  # frames that reached the daemon undamaged
    overflow: int = 0
    missing: Counter[str] = field(default_factory=Counter)  # frames that were sent and did not arrive, by cause
    in_outages: int = 0  # gates between the last frame before and the first frame after
    outages: int = 0


class SimulatedBoard:
    """A board with a scenario; its link delivers, damages or loses what it sends."""

    def __init__(self, plate: Plate, scenario: str, seed: int) -> None:
        played = load_scenario(scenario, plate)
        self._board = _emulated_board(plate, played, seed, "sums", Misbehaviour())
        self._random = random.Random(seed)
        self._tick_rate = round(plate.counter.reference_hz * (1.0 + played.physics.reference_error))  # a second
        self.gate_ns = round(S / plate.counter.frame_rate_hz)
        self._end_ns: dict[int, int] = {}  # of gates whose frames have not been read
        self._last_end_ns: int | None = None
        self._outage = False
        self.next_sequence = 0  # of the frame that begins now, not wrapped
        self.truth = Truth()
        self.sites_touched: set[int] = set()

    def ticks(self, elapsed_ns: int) -> int:
        return elapsed_ns * self._tick_rate // S

    def scenario_s(self, elapsed_ns: int) -> float:
        return (self.ticks(elapsed_ns) - (self._board.first_start_ticks or 0)) / self._tick_rate

    def read(self, elapsed_ns: int, fault: str | None) -> bytes:
        """Return what arrives; a fault concerns one frame of it, but never the first."""
        self._advance(elapsed_ns)
        data, frames = b"", 0
        while (outgoing := self._board.next_output()) is not None:
            piece = outgoing.data
            if outgoing.sequence is not None:
                frames += 1
                end_ns = self._end_ns.pop(outgoing.sequence)
                if fault is not None and frames > 1:
                    self.truth.missing[fault] += 1
                    piece = b"" if fault == "link_gap" else piece[:60] + bytes([piece[60] ^ 0xFF]) + piece[61:]
                    fault = None
                else:
                    self._delivered(end_ns)
            data += piece
        return data

    def _delivered(self, end_ns: int) -> None:
        if self._outage and self._last_end_ns is not None:
            self.truth.outages += 1
            self.truth.in_outages += max(0, round((end_ns - self._last_end_ns) / self.gate_ns) - 1)
        self._outage, self._last_end_ns = False, end_ns
        self.truth.delivered += 1

    def _advance(self, elapsed_ns: int) -> None:
        for made in self._board.advance(self.ticks(elapsed_ns)):
            self._end_ns[made.sequence] = made.end_ticks * S // self._tick_rate
            self.next_sequence = made.sequence + 1
            self.sites_touched.update(contact.site for contact in made.contacts if contact.site is not None)

    def write(self, data: bytes, elapsed_ns: int) -> None:
        self._advance(elapsed_ns)
        self._board.receive(data, self.ticks(elapsed_ns))

    def skip(self, elapsed_ns: int, cause: str) -> None:
        """Let gates pass whose frames the board drops, or the link loses."""
        gates = self._board.skip_gates(self.ticks(elapsed_ns), dropped=cause == "board_overflow")
        if cause == "board_overflow":
            self.truth.overflow += gates
        else:
            self.truth.missing[cause] += gates

    def hang_up(self, elapsed_ns: int) -> None:
        """Let time pass without a host."""
        self._board.skip_gates(self.ticks(elapsed_ns), dropped=False)
        self._board.connection_ended()
        self._end_ns.clear()
        self._outage = True

    def reboot(self, elapsed_ns: int, count_from: int) -> None:
        """Start again with a tick count of its own."""
        cause = self._board.identity.reset_cause
        self._board.reboot(self._random.randrange(1, 1 << 32), self.ticks(elapsed_ns), cause)
        self._board.step_ticks(count_from)
        self._end_ns.clear()
        self._outage = True

    def begin_account(self) -> None:
        """Count for another daemon, which has no part in the time before its first frame."""
        self.truth, self._last_end_ns, self._outage = Truth(), None, False


class SimulatedLink:
    """A link between both, as the reader of a daemon serves it; `on_event` receives what a recorder would."""

    def __init__(
        self,
        plate: Plate,
        host: SimulatedHost,
        board: SimulatedBoard,
        on_event: Callable[[wire.WireEvent], None],
        counted_before: int,
    ) -> None:
        self._host = host
        self._board = board
        self.queue = FrameQueue(1 << 30, lambda: None)
        self.machine = LinkStateMachine(plate, self.queue, on_event)
        # Counters begin just below a limit, which they then pass.
        start = LinkCounters(bytes_received=counted_before, bytes_accepted=counted_before)
        self.machine._counters = start  # noqa: SLF001 - no daemon begins with counts
        self.reopened = 0
        opening = Reason(ReasonCode.OPENING, "opening")
        self.machine.apply(wire.StateAnnounced(host.now(), Condition.STARTING, opening))
        self.machine.apply(wire.Opened(host.now()))

    def run(self, seconds: float, handle: Callable[[], None], fault: str | None = None) -> None:
        """Serve the link; `handle` is called after each read. The fault concerns one frame in the middle."""
        steps = max(1, round(seconds * S / STEP_NS))
        for step in range(steps):
            now_fault = fault if step == steps // 2 else None
            try:
                self._exchange(now_fault)
            except LinkLostError as error:
                self.lose(error.reason)
                self.open()
            handle()
            self._host.elapsed_ns += STEP_NS

    def _exchange(self, fault: str | None) -> None:
        host, machine = self._host, self.machine
        idle = True
        for turn_ns in (0, 100_000):  # the second time, answers to what the first brought
            if data := self._board.read(host.elapsed_ns + turn_ns, fault if not turn_ns else None):
                machine.apply(wire.Received(host.now(turn_ns + _DELAY_NS), data))
                idle = False
            if not turn_ns:
                machine.apply(wire.TimersRun(host.now(_DELAY_NS), idle=idle))
            if request := machine.opened.data_to_send():
                machine.apply(wire.Sent(host.now(turn_ns + 2 * _DELAY_NS), request))
                self._board.write(request, host.elapsed_ns + turn_ns + 3 * _DELAY_NS)

    def lose(self, reason: Reason = _UNPLUGGED) -> None:
        self.machine.apply(wire.Lost(self._host.now(), reason))
        self.machine.apply(wire.Closed(self._host.now()))
        self._board.hang_up(self._host.elapsed_ns)

    def open(self) -> None:
        self._board.hang_up(self._host.elapsed_ns)
        self.machine.apply(wire.Opened(self._host.now()))
        self.reopened += 1
