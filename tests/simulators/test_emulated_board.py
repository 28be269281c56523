"""The emulated board, seen from the host's end of the same protocol; time passes by hand."""

from pathlib import Path

import numpy as np
import pytest
from fake_plate import FakePlate, fake_board

from firmware_protocol.host import Frame, FramePart, HostEvent, HostSession, Pong, Rebooted
from firmware_protocol.messages import BoardStatus, Configuration, CounterKind, ResetCause
from firmware_protocol.output_queue import Outgoing
from simulators.board import MadeFrame
from simulators.faults import FaultPlan
from simulators.links import PtyLink
from simulators.output import Output

GATE_TICKS = 1000
FRAME_BYTES = 204


class Bench:
    """A board and a host, wired by hand."""

    def __init__(
        self, plate: FakePlate | None = None, queue_limit_bytes: int = 100_000, drop_rate: float = 0.0, seed: int = 0
    ) -> None:
        self.plate = plate or FakePlate()
        self.board = fake_board(self.plate, queue_limit_bytes, drop_rate=drop_rate, seed=seed)
        self.host = HostSession()
        self.now = 0

    def exchange(self) -> list[HostEvent]:
        """Carry bytes both ways until nobody has any more."""
        events: list[HostEvent] = []
        while True:
            if request := self.host.data_to_send():
                self.board.receive(request, self.now)
            outgoing = self.board.next_output()
            if outgoing is None and not request:
                return events
            if outgoing is not None:
                events += self.host.receive(outgoing.data)

    def start(self) -> list[HostEvent]:
        events = self.exchange()
        self.host.configure(Configuration(GATE_TICKS))
        return events + self.exchange()

    def advance(self, ticks: int) -> list[MadeFrame]:
        self.now += ticks
        return self.board.advance(self.now)


def frames_in(events: list[HostEvent]) -> list[Frame]:
    return [event for event in events if isinstance(event, Frame)]


def test_a_full_queue_drops_its_oldest_frames_and_reports_it_before_the_next_that_goes_out() -> None:
    bench = Bench(queue_limit_bytes=3 * FRAME_BYTES + 20)
    bench.start()
    bench.advance(10 * GATE_TICKS)
    assert bench.board.frames_queued == 3
    events = bench.exchange()
    assert events[0] == BoardStatus(7, bytes_discarded=0)
    assert [frame.sequence for frame in frames_in(events)] == [7, 8, 9]
    assert len(events) == 4
    bench.advance(2 * GATE_TICKS)
    assert [type(event) for event in bench.exchange()] == [Frame, Frame]
    bench.advance(5 * GATE_TICKS)
    assert bench.exchange()[0] == BoardStatus(9, bytes_discarded=0)


@pytest.mark.parametrize("ticks", [2**32 + 7, -50_000])
def test_a_jump_of_the_tick_count_is_one_of_frames_records_and_pongs_alike(ticks: int) -> None:
    bench = Bench()
    bench.advance(100_000)
    bench.start()
    bench.advance(3 * GATE_TICKS)  # of a block of four
    bench.board.step_ticks(ticks)
    bench.advance(2 * GATE_TICKS)
    frames = frames_in(bench.exchange())
    assert [frame.sequence for frame in frames] == list(range(5))
    steps = np.diff([frame.board_ticks for frame in frames]).tolist()
    assert steps == [GATE_TICKS] * 3 + [GATE_TICKS + ticks]
    assert [asked[0] for asked in bench.plate.asked] == [100_000, 100_000 + 4 * GATE_TICKS + ticks]
    bench.host.ping(b"12345678")
    assert bench.exchange() == [Pong(b"12345678", bench.now + ticks)]
    bench.board.reboot(78, bench.now, ResetCause.SOFTWARE)
    bench.board.step_ticks(5)  # while nothing is counted: at once
    bench.host.ping(b"12345678")
    assert bench.exchange()[:2] == [Rebooted(78), Pong(b"12345678", 5)]


def test_a_channelised_frame_goes_out_whole_in_parts() -> None:
    bench = Bench(FakePlate(CounterKind.CHANNELISED, tones=3072, block_frames=1), queue_limit_bytes=400_000)
    bench.start()
    bench.advance(4 * GATE_TICKS)
    frames: list[Outgoing] = list(iter(bench.board.next_output, None))
    events = [bench.host.receive(frame.data) for frame in frames]
    assert [len(each) for each in events] == [1 + 20, 20]
    status, *parts = events[0] + events[1]
    assert status == BoardStatus(2, bytes_discarded=0)
    assert all(isinstance(part, FramePart) for part in parts)
    tones = np.zeros((2, 4, 3072), dtype=int)
    for part in parts:
        assert isinstance(part, FramePart)
        assert part.tones == bytes([part.block.channel]) * len(part.tones)
        block = part.block
        tones[part.sequence - 2, block.channel, block.first_tone : block.first_tone + block.tones] += 1
    assert np.all(tones == 1)


class NarrowLink(PtyLink):
    """Link to a host that takes `room` bytes."""

    room, taken = 10**6, b""

    def write(self, data: bytes | memoryview) -> int:
        piece = bytes(data[: self.room])
        self.room -= len(piece)
        self.taken += piece
        return len(piece)


def test_a_frame_that_is_cut_off_with_its_connection_is_reported_to_the_next_host(tmp_path: Path) -> None:
    bench, link = Bench(), NarrowLink(tmp_path / "board")
    output = Output(bench.board, link, FaultPlan(), 0)
    bench.start()
    for room in (FRAME_BYTES, FRAME_BYTES - 1):
        bench.advance(GATE_TICKS)
        link.room = room
        output.send(0, 0.0)
    link.hang_up()
    output.send(0, 0.0)
    link.plug_in()
    bench.advance(GATE_TICKS)
    bench.board.receive(b"noise", bench.now)
    output.send(0, 0.0)
    bench.host.ping(b"12345678")
    bench.board.receive(bench.host.data_to_send(), bench.now)
    bench.advance(GATE_TICKS)
    link.taken, link.room = b"", 10**6
    output.send(0, 0.0)
    _, status, frame = bench.host.receive(link.taken)
    assert isinstance(frame, Frame)
    assert (status, frame.sequence) == (BoardStatus(2, bytes_discarded=5), 3)  # the other one had no host
    link.close()
