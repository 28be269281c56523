"""How a link stands: enough for another connection to go on from it, and only told where one could."""

from pathlib import Path

from connection_bench import GATE_TICKS, MS, PLATE, Bench, board
from emulation import emulated
from listener import Listener, frames
from recording_bench import replayed, same

from firmware_protocol.packets import Packet, PacketDecoder
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.switch import RecordingSwitch
from resonator_daemon.board.session.connection import Connection
from resonator_daemon.board.session.frame_numbers import FrameNumbering
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import LinkCounters
from resonator_daemon.board.session.link_events import Received, SnapshotTaken, WireEvent
from resonator_daemon.board.session.link_state import LinkState
from resonator_daemon.board.session.link_state_machine import LinkStateMachine
from simulators.emulator import EmulatorOptions

SKIN = load_plate("skin32")


def test_pings_on_their_way_teach_the_clock_of_whoever_joins() -> None:
    bench = Bench(board(), delay_ns=5 * MS)
    bench.run(300)
    while (running := bench.connection.snapshot()) is None or not running.pings:
        bench.run(0.5)
    bench.board.session.receive = lambda _data, _ticks: b""  # type: ignore[method-assign]  # these are the last
    queue = FrameQueue(64 << 20, lambda: None)
    numbering = FrameNumbering(PLATE.frame_bytes, GATE_TICKS, MS)
    numbering.restore(bench.numbering.snapshot())
    state = LinkState(queue.put)
    state.restore(bench.state.snapshot(), bench.host_time().utc_ns)
    other = Connection(PLATE, None, numbering, queue, LinkCounters(), state, bench.host_time())
    other.restore(running)
    before = running.clock
    for _, data in bench._on_the_way:
        other.receive(data, bench.host_time())
        bench.connection.receive(data, bench.host_time())
    assert other.clock.snapshot() == bench.connection.clock.snapshot() != before
    arrivals = bench.queue.pop_all()
    assert len(frames(arrivals)) > 2
    assert frames(queue.pop_all()) == frames(arrivals)


def test_no_link_is_told_to_stand_in_the_middle_of_a_frame(tmp_path: Path) -> None:
    whole: list[WireEvent] = []
    with emulated(EmulatorOptions("skin32", tcp=("127.0.0.1", 0))) as emulator:
        link = parse_link(emulator.link.address)
        with Listener(link, SKIN, on_event=whole.append) as it:
            it.wait_for_frames(80)
    queue = FrameQueue(64 << 20, lambda: None)
    switch = RecordingSwitch()
    machine = LinkStateMachine(SKIN, queue, switch.put, snapshot_every_ns=0)  # at every packet, where it may be
    path = tmp_path / "run.mcap"
    decoder = PacketDecoder(from_board=True)
    started = False
    for event in in_packets([event for event in whole if not isinstance(event, SnapshotTaken)], decoder):
        machine.apply(event)
        if not started and (machine.counters().frames == 40 and machine.counters().bytes_waiting == 0):
            switch.start(path, Origin(SKIN, str(link)))
            started = True
    switch.stop()
    arrivals, counters, differences = replayed(path, SKIN)
    assert differences == 0
    live = {frame.index: frame for frame in frames(queue.pop_all())}
    assert len(frames(arrivals)) > 30
    assert all(same(frame, live[frame.index]) for frame in frames(arrivals))
    assert counters.parts_lost <= machine.counters().parts_lost  # a busy computer loses some, the replay none


def in_packets(events: list[WireEvent], decoder: PacketDecoder) -> list[WireEvent]:
    """Return the events with each packet received by itself."""
    cut: list[WireEvent] = []
    buffer = b""
    for event in events:
        if not isinstance(event, Received):
            cut.append(event)
            continue
        buffer += event.data
        for found in decoder.feed(event.data):
            assert isinstance(found, Packet)
            cut.append(Received(event.now, buffer[: found.size_bytes]))
            buffer = buffer[found.size_bytes :]
    return cut
