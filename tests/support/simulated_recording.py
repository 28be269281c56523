"""Recordings of emulated boards in simulated time, as fast as their frames are computed."""

from pathlib import Path

from threadpoolctl import threadpool_limits

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.config.values import config_of, load_settings_text, plate_text, settings_text
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.writer import RecordingWriter
from resonator_daemon.board.session import link_events as wire
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import BoardOnline
from resonator_daemon.board.session.link_state_machine import LinkStateMachine
from resonator_daemon.daemon.service.recordings import RecordedMessages
from resonator_daemon.measure.pipeline.board_pipeline import BoardPipeline
from simulators.emulator import emulated_board
from simulators.faults.misbehaviour import Misbehaviour
from simulators.scenario import load_scenario
from simulators.scenario_file import default_scenario
from simulators.world import World

STEP_NS = 10_000_000
UTC_NS = 1_789_000_000 * 10**9
BOOT_ID = "0123456789abcdef"
NAME = "left-index"
SETTINGS = "[measurement]\n[decoding]\n"


def record(
    path: Path,
    plate: Plate,
    seconds: float,
    *,
    scenario: str | None = None,
    include_messages: bool = False,
    utc_ns: int = UTC_NS,
) -> None:
    """Record a board for so many simulated seconds; with messages, those of a daemon that decodes are included."""
    link = parse_link("tcp://127.0.0.1:1")
    config = config_of(plate, load_settings_text(SETTINGS, path), link, name=NAME)
    origin = Origin(plate, str(link), NAME, BOOT_ID, None, plate_text(plate), settings_text(config))
    writer = RecordingWriter(path, origin, utc_ns)
    messages = RecordedMessages(writer.publish, include_messages=include_messages)
    pipeline = BoardPipeline(config, BOOT_ID, messages.record) if include_messages else None
    events = _WrittenEvents(writer)
    queue = FrameQueue(1 << 30, lambda: None, ())
    machine = LinkStateMachine(plate, queue, events.put)
    played = load_scenario(scenario or default_scenario(plate), plate)
    board = emulated_board(World(plate), played, 0, "sums", Misbehaviour(""))
    ticks_per_ns = plate.counter.reference_hz * (1.0 + played.physics.reference_error) * 1e-9

    def now(elapsed_ns: int) -> HostTime:
        return HostTime(10**12 + elapsed_ns, utc_ns - 10**12, 0)

    def send(elapsed_ns: int) -> None:
        if request := machine.opened.session.data_to_send():
            ticks = int((elapsed_ns + 20_000) * ticks_per_ns)
            machine.apply(wire.Sent(now(elapsed_ns), request))
            board.advance(ticks)
            board.receive(request, ticks)

    with threadpool_limits(1):
        machine.apply(wire.StateAnnounced(now(0), Condition.STARTING, Reason(ReasonCode.OPENING, "opening")))
        machine.apply(wire.Opened(now(0)))
        for elapsed_ns in range(0, round(seconds * 1e9), STEP_NS):
            # Timers create pings, which are sent at that time; their answers arrive 50 us later.
            machine.apply(wire.TimersRun(now(elapsed_ns), idle=elapsed_ns > 0))
            for start_ns in (elapsed_ns, elapsed_ns + 100_000):  # the second time, answers to the first data
                send(start_ns)
                board.advance(int((start_ns + 40_000) * ticks_per_ns))
                while (outgoing := board.next_output()) is not None:
                    machine.apply(wire.Received(now(start_ns + 50_000), outgoing.data))
            send(elapsed_ns + 200_000)
            for arrival in queue.pop_all():
                if isinstance(arrival, BoardOnline):
                    writer.name_board(arrival)
                if pipeline is not None:
                    pipeline.handle(arrival)
        machine.apply(wire.Closed(now(round(seconds * 1e9))))
    writer.finish()
    writer.sync()
    writer.close()


class _WrittenEvents:
    """Passes events to a file, and of the snapshots those that a recorder writes."""

    def __init__(self, writer: RecordingWriter) -> None:
        self._writer = writer

    def put(self, event: wire.WireEvent) -> None:
        writer = self._writer
        is_written = not writer.replayable or (writer.snapshot_due and not _is_of_closed_link(event))
        if not isinstance(event, wire.SnapshotTaken) or is_written:
            writer.write(event)
        if event.now.monotonic_ns % 1_000_000_000 < STEP_NS:
            writer.flush()


def _is_of_closed_link(event: wire.WireEvent) -> bool:
    return isinstance(event, wire.SnapshotTaken) and event.snapshot.running is None
