"""What a board, its link and a daemon do in simulated time, for `year.py`: bursts of frames, and skips between them."""

import asyncio
import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.config import Config
from resonator_daemon.board.links.link import LinkLostError
from resonator_daemon.board.session import link_events as wire
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.frame_queue import FrameQueue, group_adjacent
from resonator_daemon.board.session.link_state_machine import LinkStateMachine
from resonator_daemon.measure.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.mqtt.broker_connection import MQTT_5, PACKET_BYTES_MAX, InFlight
from resonator_daemon.mqtt.codec import decode, decoded, encode
from resonator_daemon.mqtt.message_account import Account
from resonator_daemon.mqtt.outbox import Outbox
from resonator_daemon.mqtt.packets import Packet, properties_of
from resonator_daemon.mqtt.payloads import ContactEvent, Message
from resonator_daemon.mqtt.topics import CONTACT_EVENT, STATE_LINK, STATE_SENSOR, Topic
from simulators.emulator import emulated_board
from simulators.faults.misbehaviour import Misbehaviour
from simulators.scenario import load_scenario
from simulators.world import with_world

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
        self._board = emulated_board(with_world(plate, ""), played, seed, "sums", Misbehaviour())
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
    """A link between both, as the reader of a daemon serves it."""

    def __init__(self, plate: Plate, host: SimulatedHost, board: SimulatedBoard) -> None:
        self._host = host
        self._board = board
        self.queue = FrameQueue(1 << 30, lambda: None)
        self.machine = LinkStateMachine(plate, self.queue, lambda _: None)
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
            if request := machine.opened.session.data_to_send():
                machine.apply(wire.Sent(host.now(turn_ns + 2 * _DELAY_NS), request))
                self._board.write(request, host.elapsed_ns + turn_ns + 3 * _DELAY_NS)

    def lose(self, reason: Reason = _UNPLUGGED) -> None:
        self.machine.apply(wire.Lost(self._host.now(), reason))
        self.machine.apply(wire.Closed(self._host.now()))
        self._board.hang_up(self._host.elapsed_ns)

    def open(self) -> None:
        self._board.hang_up(self._host.elapsed_ns)
        self.machine.apply(wire.Opened(self._host.now()))


BLOCK: Final = 50
HANDSHAKE_FRAMES: Final = 100  # that an outage lasts longer, until the board is identified
_CLOSE_S: Final = 10.0


@dataclass
class Seen:
    """Messages that subscribers received in the whole time, and their errors."""

    messages: Counter[str] = field(default_factory=Counter)
    events: Counter[tuple[str, int]] = field(default_factory=Counter)  # by boot and seq: how often delivered
    events_published: int = 0
    backwards: list[str] = field(default_factory=list)
    sensor_states: list[tuple[str, str, int]] = field(default_factory=list)  # boot, reason code, since
    compensated: int = 0
    unbalanced: list[str] = field(default_factory=list)


@dataclass
class World:
    """What outlives a daemon."""

    config: Config
    host: SimulatedHost
    board: SimulatedBoard
    spool: Path
    seen: Seen


class RecordingBroker:
    """Substitute for a connection: accepts and acknowledges all packets; adds events to `seen`."""

    version = MQTT_5
    writable = True
    unacknowledged = 0
    messages_in_flight = 0
    receive_maximum = 65_535
    packet_bytes_max = PACKET_BYTES_MAX

    def __init__(self, outbox: Outbox, seen: Seen) -> None:
        self.in_flight: dict[int, InFlight] = {}
        self._outbox, self._seen = outbox, seen

    def send(self, topic: str, payload: bytes, *, qos: int, token: object, **_: object) -> None:
        if topic.endswith(CONTACT_EVENT.path):
            event = decode(ContactEvent, payload)
            self._seen.events[event.daemon_boot_id, event.seq] += 1
        acknowledged = InFlight(qos, time.monotonic(), token)
        asyncio.get_running_loop().call_soon(self._outbox.published, acknowledged, 0)

    def send_streams(self, packets: list[bytes]) -> tuple[int, int]:
        return len(packets), len(packets)


class SimulatedDaemon:
    """A daemon from its start to its end; the next one continues with its spool."""

    def __init__(self, world: World, boot_id: str) -> None:
        self._host, self._board, self._seen, self._boot_id = world.host, world.board, world.seen, boot_id
        self.onsets: list[tuple[int, int]] = []  # number and site
        self.releases: list[tuple[int, int]] = []
        self._open_contacts: set[int] = set()
        self._newest_ns: dict[str, int] = {}
        self._newest: dict[str, Any] = {}
        self._set_back_ns: dict[str, int] = {}
        self._account = Account()
        self.outbox = Outbox(self._account, world.spool, 1e9, boot_id=boot_id)
        self.pipeline = BoardPipeline(world.config, boot_id, self._publish, lambda: (self._account.missed, 0))
        world.board.begin_account()
        self.link = SimulatedLink(world.config.plate, world.host, world.board)
        self.outbox.events.start(lambda: None)

    def connect(self) -> None:
        self.outbox.connected(RecordingBroker(self.outbox, self._seen))  # type: ignore[arg-type]
        self.outbox.republish()

    def clock_set(self, step_ns: int) -> None:
        """Allow each topic one step back."""
        if step_ns < 0:
            for path in self._newest_ns:
                self._set_back_ns[path] = self._set_back_ns.get(path, 0) - step_ns

    def burst(self, seconds: float, fault: str | None = None) -> None:
        """Receive frames."""
        self.link.run(seconds, self._handle, fault)

    def _handle(self) -> None:
        for arrival in group_adjacent(self.link.queue.pop_all(), BLOCK):
            self.pipeline.handle(arrival)

    def _publish(self, topic: Topic[Any], message: Any) -> None:
        self._seen.messages[topic.path] += 1
        t_ns, newest_ns = message.t_ns, self._newest_ns.get(topic.path, 0)
        if t_ns < newest_ns:
            allowed_ns = self._set_back_ns.pop(topic.path, 0) + self._uncertainty_ns(topic, self._newest[topic.path])
            if newest_ns - t_ns > allowed_ns or topic in (STATE_LINK, STATE_SENSOR):
                back_s = (newest_ns - t_ns) / S
                self._seen.backwards.append(f"{topic.path} by {back_s:.6f} s, {allowed_ns / S:.6f} s allowed")
        self._newest_ns[topic.path], self._newest[topic.path] = t_ns, message
        if topic is CONTACT_EVENT:
            self._follow(message)
        if topic is STATE_SENSOR:
            self._seen.sensor_states.append((self._boot_id, str(message.reason_code), message.since_t_ns))
            self._seen.compensated += message.compensation is not None
        if isinstance(message, Message):
            self._account.enqueued += 1
            if topic.retained:
                self.outbox.put_retained(Packet(f"resonator/{topic.path}", encode(message), properties_of(topic)))
            elif topic is CONTACT_EVENT:
                self.outbox.put_event(f"resonator/{topic.path}", message)
                self._seen.events_published += 1
            else:
                self._account.written += 1

    def _uncertainty_ns(self, topic: Topic[Any], message: Any) -> int:
        return int(decoded(topic.payload, message).t_uncertainty_ns)

    def _follow(self, event: ContactEvent) -> None:
        contact = event.contact
        if event.event == "onset":
            self.onsets.append((contact.id, contact.site))
            self._open_contacts.add(contact.id)
        elif event.event == "release":
            self.releases.append((contact.id, contact.site))
            if contact.id not in self._open_contacts:
                self._seen.unbalanced.append(f"{self._boot_id}: contact {contact.id} is released without an onset")
            self._open_contacts.discard(contact.id)

    async def end(self) -> None:
        """Stop the daemon; check that each account balances."""
        self.outbox.disconnected()
        await asyncio.wait_for(self.outbox.events.close(), _CLOSE_S)
        truth, counters = self._board.truth, self.link.machine.counters()
        # Frames of the run before a reopening are stale; those between a suspend and the next ping have no time.
        refused = counters.messages_stale + counters.messages_malformed
        placed = counters.bytes_accepted + counters.bytes_other_version + counters.bytes_echo
        found = {
            "frames": (counters.frames + refused, truth.delivered),
            "damaged": (counters.lost.damaged, truth.missing["damaged"]),
            "board_overflow": (counters.lost.board_overflow, truth.overflow),
            "bytes": (counters.bytes_received, placed + counters.bytes_discarded + counters.bytes_waiting),
        }
        wrong = [f"{what} {seen}, asked {asked}" for what, (seen, asked) in found.items() if seen != asked]
        lost = truth.overflow + sum(truth.missing.values()) + truth.in_outages
        if abs(counters.lost.total - lost) > HANDSHAKE_FRAMES * truth.outages + refused:
            wrong.append(f"{counters.lost.total} frames lost, asked {lost} with {truth.outages} outages")
        if self._open_contacts:
            wrong.append(f"contacts {sorted(self._open_contacts)} are not released")
        account = self._account
        came_to = account.acknowledged + account.written + sum(account.dropped.values()) + self.outbox.waiting
        if account.enqueued != came_to + account.unknown_at_disconnect:
            wrong.append(
                f"messages {account.enqueued}, accounted for {came_to}, {account.unknown_at_disconnect} unknown"
            )
        if wrong:
            self._seen.unbalanced.append(f"{self._boot_id}: {'; '.join(wrong)} {asdict(counters.lost)} {truth}")
