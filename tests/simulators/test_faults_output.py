"""From a board's queue to its link, with a link that does as it is told; time passes by hand."""

from fake_plate import FakePlate, fake_board

from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import Configuration, ResetCause, encode_message
from firmware_protocol.packets import Packet, PacketDecoder, encode_packet
from simulators.faults import FaultPlan
from simulators.output import Output

GATE_TICKS = MS = 1_000_000  # ticks are ns here
FRAME_BYTES = 204


class FakeLink:
    """Output that accepts `room` bytes and then no more, until there is room again."""

    address = "fake"
    read_fds: tuple[int, ...] = ()

    def __init__(self) -> None:
        self.write_fd: int | None = 0
        self.room = 10**9
        self.writes: list[bytes] = []

    def read(self) -> bytes:
        return b""

    def write(self, data: bytes | memoryview) -> int:
        taken = bytes(data[: self.room])
        self.room -= len(taken)
        self.writes += [taken] if taken else []
        return len(taken)

    def hang_up(self) -> None:
        self.write_fd = None

    def plug_in(self) -> None:
        self.write_fd = 0

    def close(self) -> None: ...

    def packets(self) -> list[Packet]:
        found = PacketDecoder(from_board=True).feed(b"".join(self.writes))
        return [packet for packet in found if isinstance(packet, Packet)]

    def frames(self) -> list[int]:
        return [packet.sequence for packet in self.packets() if packet.type == MessageType.FRAME]


class Bench:
    """A running board on a fake link."""

    def __init__(self, queue_frames: int = 1000, **faults: object) -> None:
        self.board = fake_board(FakePlate(block_frames=1, reference_millihertz=10**12), queue_frames * FRAME_BYTES)
        self.link = FakeLink()
        self.output = Output(self.board, self.link, FaultPlan.model_validate(faults), 1)
        self.now_ns = 0
        self.request(MessageType.CONFIGURE, encode_message(Configuration(GATE_TICKS)))
        self.request(MessageType.START)
        self.output.send(10**9, 0.0)  # whatever holds the answers
        self.link.writes.clear()

    def request(self, kind: MessageType, payload: bytes = b"") -> None:
        self.board.receive(encode_packet(kind, 1, payload), self.now_ns)

    def pass_ms(self, milliseconds: int) -> None:
        for _ in range(milliseconds):
            self.now_ns += MS
            self.board.advance(self.now_ns)
            self.output.send(10**9 + self.now_ns, self.now_ns * 1e-9)


def test_a_host_that_does_not_read_costs_the_oldest_frames_but_never_one_that_has_begun() -> None:
    bench = Bench(queue_frames=3)
    bench.link.room = 100
    bench.pass_ms(10)
    assert bench.output.waits_for_room
    assert bench.output.frames_unsent == 1
    bench.link.room = 10**9
    bench.pass_ms(1)
    status, frames = bench.link.packets()[1], bench.link.frames()
    assert frames == [0, 8, 9, 10]
    assert status.type == MessageType.STATUS
    assert bench.board.frames_crowded_out == 7


def test_pieces_and_clumps_carry_the_same_bytes() -> None:
    plain, split, clumped = Bench(), Bench(split_bytes=5), Bench(clump_ms=16.0, split_bytes=1)
    for bench in (plain, split, clumped):
        bench.pass_ms(64)
    assert b"".join(plain.link.writes) == b"".join(split.link.writes)
    assert {len(data) for data in split.link.writes} == {1, 2, 3, 4, 5}
    assert {len(data) for data in clumped.link.writes} == {1}
    assert clumped.link.frames() == list(range(len(clumped.link.frames())))
    assert 64 - 16 <= len(clumped.link.frames()) <= 64


def test_damage_counts_once_it_has_gone_out() -> None:
    bench = Bench(bit_error_rate=1.0)
    bench.link.room = 100
    bench.pass_ms(2)
    assert bench.output.counts.frames_hit == 0
    bench.link.room = 200
    bench.pass_ms(1)
    assert bench.output.counts.frame_sequences_hit == [0]
    bench.link.hang_up()
    bench.pass_ms(1)
    bench.link.plug_in()
    bench.output.asked = True
    bench.link.room = 10**9
    bench.pass_ms(1)
    assert bench.output.counts.frame_sequences_hit == [0, 4]
    assert bench.output.frames_sent == 2


def test_a_brown_out_ends_the_board_in_the_middle_of_a_frame() -> None:
    bench = Bench()
    bench.pass_ms(3)
    bench.output.cut_next_frame(lambda: bench.board.reboot(78, bench.now_ns, ResetCause.BROWN_OUT))
    bench.pass_ms(3)
    assert bench.link.frames() == [0, 1, 2]
    assert len(b"".join(bench.link.writes)) == 3 * FRAME_BYTES + FRAME_BYTES // 2
    assert bench.output.counts.frame_sequences_cut == [3]
    assert bench.output.frames_sent == 3
    bench.link.writes.clear()
    bench.request(MessageType.PING, b"12345678")
    bench.pass_ms(1)
    assert [packet.boot_id for packet in bench.link.packets()] == [78]
