"""One run of a daemon in simulated time: session, pipeline, event queue on disk, and a substitute for the broker."""

import asyncio
import json
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from itertools import starmap
from typing import Any, Final, NamedTuple

from simulated_disk import RunRecorder, SimulatedDisk
from simulated_link import S, SimulatedBoard, SimulatedHost, SimulatedLink

from resonator_daemon.config import Config
from resonator_daemon.monitoring.health import HealthMonitor
from resonator_daemon.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.plate import Plate
from resonator_daemon.publishing.broker_connection import MQTT_5, InFlight
from resonator_daemon.publishing.broker_limits import BrokerLimits
from resonator_daemon.publishing.codec import decode, decoded, encode
from resonator_daemon.publishing.message_account import Account
from resonator_daemon.publishing.outbox import Outbox, Packet
from resonator_daemon.publishing.packed_properties import properties_of
from resonator_daemon.publishing.payloads import ContactEvent, Health, Message, MessageAccount, RecordingInfo
from resonator_daemon.publishing.topics import CONTACT_EVENT, HEALTH, STATE_LINK, STATE_SENSOR, Topic
from resonator_daemon.session import link_events as wire
from resonator_daemon.session.clock import Instant
from resonator_daemon.session.frame_queue import FrameQueue
from resonator_daemon.session.frames import Arrival, Frame, in_blocks
from resonator_daemon.session.link_state_machine import LinkStateMachine

EXACT: Final = 1 << 53  # largest integer that every reader of JSON has exactly
BLOCK: Final = 50
HANDSHAKE_FRAMES: Final = 100  # that an outage lasts longer, until the board is identified
_CLOSE_S: Final = 10.0
_NO_RECORDING: Final = RecordingInfo(
    file=None, since_t_ns=None, failure=None, file_bytes=0, files=0, files_removed=0, events_missing=0,
    messages=0, messages_missing=0,
)  # fmt: skip


@dataclass
class Seen:
    """Messages that subscribers received in the whole time, and their errors."""

    messages: Counter[str] = field(default_factory=Counter)
    events: Counter[tuple[str, int]] = field(default_factory=Counter)  # by boot and seq: how often delivered
    events_published: int = 0
    backwards: list[str] = field(default_factory=list)
    inexact: Counter[str] = field(default_factory=Counter)  # integers of JSON beyond 2^53, by key
    sensor_states: list[tuple[str, str, int]] = field(default_factory=list)  # boot, reason code, since
    compensated: int = 0
    unbalanced: list[str] = field(default_factory=list)
    replayed: int = 0
    replay_differs: int = 0


class RecordingBroker:
    """Substitute for a connection: accepts and acknowledges all packets; adds events to `seen`."""

    version = MQTT_5
    writable = True
    unacknowledged = 0
    messages_in_flight = 0
    limits = BrokerLimits()

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

    def __init__(
        self,
        config: Config,
        plate: Plate,
        boot_id: str,
        host: SimulatedHost,
        board: SimulatedBoard,
        disk: SimulatedDisk,
        seen: Seen,
        counted_before: int,
    ) -> None:
        self._host, self._board, self._plate, self._seen = host, board, plate, seen
        self._boot_id = boot_id
        self.onsets: list[tuple[int, int]] = []  # number and site
        self.releases: list[tuple[int, int]] = []
        self._open_contacts: set[int] = set()
        self._newest_ns: dict[str, int] = {}
        self._newest: dict[str, Any] = {}
        self._set_back_ns: dict[str, int] = {}
        self._account = Account()
        self.outbox = Outbox(self._account, disk.path / "spool", 1e9, boot_id=boot_id)
        self._recorder = RunRecorder(config, plate, boot_id, disk)
        self._shadow: tuple[LinkStateMachine, FrameQueue] | None = None
        self._wants_shadow = False
        self._live_frames: list[_Frame] = []
        self._monitor = HealthMonitor()
        self.pipeline = BoardPipeline(config, boot_id, self._publish, lambda: (self._account.missed, 0))
        board.begin_account()
        self.link = SimulatedLink(plate, host, board, self._on_event, counted_before)
        self.outbox.events.start(lambda: None)

    @property
    def disk_failed(self) -> bool:
        """Whether neither the spool nor the recording gets anything on the disk."""
        return self._recorder.failed and self._unwritten

    @property
    def disk_works(self) -> bool:
        """Whether the disk has all events, and a recording that continues."""
        return not self._recorder.failed and not self._unwritten

    @property
    def _unwritten(self) -> bool:
        history = self.outbox.events.history
        return history is not None and history.unwritten

    def connect(self) -> None:
        self.outbox.connected(RecordingBroker(self.outbox, self._seen), at_once=True)  # type: ignore[arg-type]
        self.outbox.republish(self.outbox.retained_topics)

    def clock_set(self, step_ns: int) -> None:
        """Allow each topic one step back."""
        if step_ns < 0:
            for path in self._newest_ns:
                self._set_back_ns[path] = self._set_back_ns.get(path, 0) - step_ns

    def burst(self, seconds: float, fault: str | None = None, *, replay: bool = False) -> None:
        """Receive frames; with `replay`, a second state machine replays the stored events from a snapshot."""
        self._wants_shadow = replay
        self.link.run(seconds, self._handle, fault)
        if self._shadow is not None:
            _, queue = self._shadow
            again = [_of_frame(arrival) for arrival in queue.pop_all() if isinstance(arrival, Frame)]
            self._seen.replayed += len(again)
            live = self._live_frames[len(self._live_frames) - len(again) :]
            self._seen.replay_differs += sum(starmap(_differ, zip(again, live, strict=True)))
            self._shadow = None
        self._live_frames.clear()

    def _handle(self) -> None:
        for arrival in self._arrivals():
            self.pipeline.handle(arrival)

    def _arrivals(self) -> Iterator[Arrival | list[Frame]]:
        arrivals = self.link.queue.pop_all()
        if self._shadow is not None or self._wants_shadow:
            self._live_frames += [_of_frame(arrival) for arrival in arrivals if isinstance(arrival, Frame)]
        return in_blocks(arrivals, BLOCK)

    def _on_event(self, event: wire.WireEvent) -> None:
        self._recorder.put(event)
        stored = None
        if self._shadow is not None or self._wants_shadow:
            stored = wire.decode(wire.encode(event), event.now.monotonic_ns, event.now.utc_ns)
        if isinstance(stored, wire.SnapshotTaken):
            if self._wants_shadow and stored.snapshot.running is not None:
                queue = FrameQueue(1 << 30, lambda: None)
                self._shadow, self._wants_shadow = (LinkStateMachine(self._plate, queue, lambda _: None), queue), False
                self._shadow[0].apply(stored)
        elif stored is not None and self._shadow is not None:
            self._shadow[0].apply(stored)

    def _publish(self, topic: Topic[Any], message: Any) -> None:
        self._seen.messages[topic.path] += 1
        t_ns, newest_ns = message.t_ns, self._newest_ns.get(topic.path, 0)
        if t_ns < newest_ns:
            allowed_ns = self._set_back_ns.pop(topic.path, 0) + self._uncertainty_ns(topic, self._newest[topic.path])
            if newest_ns - t_ns > allowed_ns or topic in (STATE_LINK, STATE_SENSOR):
                back_s = (newest_ns - t_ns) / S
                self._seen.backwards.append(f"{topic.path} by {back_s:.6f} s, {allowed_ns / S:.6f} s allowed")
        self._newest_ns[topic.path], self._newest[topic.path] = t_ns, message
        if self._seen.messages[topic.path] % 50 == 1 or topic.retained or topic is HEALTH:
            self._check_integers(topic.path, message)
        if topic is CONTACT_EVENT:
            self._follow(message)
        if topic is STATE_SENSOR:
            self._seen.sensor_states.append((self._boot_id, str(message.reason_code), message.since_t_ns))
            self._seen.compensated += message.compensation is not None
        if isinstance(message, Message):
            self._account.enqueued += 1
            if topic.retained:
                self.outbox.put_state(Packet(f"resonator/{topic.path}", encode(message), properties_of(topic)))
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

    def _check_integers(self, path: str, message: Any) -> None:
        def check(value: Any, key: str) -> None:
            if isinstance(value, dict):
                for name, part in value.items():
                    check(part, f"{key}.{name}")
            elif isinstance(value, list):
                for part in value:
                    check(part, key)
            elif isinstance(value, int) and abs(value) > EXACT:
                self._seen.inexact[key] += 1

        check(json.loads(encode(message)), path)

    def report_health(self) -> Health:
        counters = self.link.machine.counters()
        utc_ns = self._host.utc_ns
        health = self._monitor.report(
            self.pipeline.headers.of(HEALTH, utc_ns), counters, self.account(), 0.0, {}, {}, _NO_RECORDING, {}
        )
        self._publish(HEALTH, health)
        return health

    def account(self) -> MessageAccount:
        account = self._account
        return MessageAccount(
            enqueued=account.enqueued, acknowledged=account.acknowledged, written=account.written,
            dropped=dict(account.dropped), unknown_at_disconnect=account.unknown_at_disconnect,
            waiting=self.outbox.waiting,
        )  # fmt: skip

    async def end(self) -> None:
        """Stop the daemon; check that each account balances."""
        self.report_health()
        self.outbox.disconnected()
        self.outbox.close()
        await asyncio.wait_for(self.outbox.events.close(), _CLOSE_S)
        truth, counters = self._board.truth, self.link.machine.counters()
        # Frames of the run before a reopening are stale; those between a suspend and the next ping have no time.
        refused = counters.messages_stale + counters.messages_malformed
        seen = {
            "frames": counters.frames + refused,
            "damaged": counters.lost.damaged,
            "board_overflow": counters.lost.board_overflow,
            "bytes": counters.bytes_received,
        }
        asked = {
            "frames": truth.delivered,
            "damaged": truth.missing["damaged"],
            "board_overflow": truth.overflow,
            "bytes": counters.bytes_accepted + counters.bytes_other_version + counters.bytes_echo
            + counters.bytes_discarded + counters.bytes_waiting,
        }  # fmt: skip
        wrong = [f"{what} {seen[what]}, asked {asked[what]}" for what in seen if seen[what] != asked[what]]
        lost = truth.overflow + sum(truth.missing.values()) + truth.in_outages
        if abs(counters.lost.total - lost) > HANDSHAKE_FRAMES * truth.outages + refused:
            wrong.append(f"{counters.lost.total} frames lost, asked {lost} with {truth.outages} outages")
        if self._open_contacts:
            wrong.append(f"contacts {sorted(self._open_contacts)} are not released")
        account = self.account()
        came_to = account.acknowledged + account.written + sum(account.dropped.values())
        came_to += account.unknown_at_disconnect + account.waiting
        if account.enqueued != came_to:
            wrong.append(f"messages {account.enqueued}, accounted for {came_to}: {account}")
        if recordings := self._recorder.end():
            wrong.append(recordings)
        if wrong:
            self._seen.unbalanced.append(f"{self._boot_id}: {'; '.join(wrong)} {asdict(counters.lost)} {truth}")


class _Frame(NamedTuple):
    index: int
    board_ticks: int
    middle: Instant


def _of_frame(frame: Frame) -> _Frame:
    return _Frame(frame.index, frame.board_ticks, frame.gate_middle)


def _differ(replayed: _Frame, live: _Frame) -> bool:
    """Return whether two frames differ in number or ticks, or their times by more than their uncertainties."""
    apart_ns = abs(replayed.middle.utc_ns - live.middle.utc_ns)
    return replayed[:2] != live[:2] or apart_ns > live.middle.uncertainty_ns + replayed.middle.uncertainty_ns
