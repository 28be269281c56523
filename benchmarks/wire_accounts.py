"""Whether every byte and frame is accounted for under each kind of loss, over the wrap of frame numbers.

Run it with `make soak`, or `python benchmarks/wire_accounts.py [FRAMES]`. Exit code 1 when a frame or byte is in the
wrong place. The truth is what a reader finds that knows every packet sent and compares bytes; nothing of it comes
from the daemon's decoder.
"""

import sys
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.device import DeviceSession
from firmware_protocol.layouts import CHANNEL_COUNT, SINGLE_TONE_STRUCT
from firmware_protocol.messages import BoardStatus, CounterKind, Description, Identity
from firmware_protocol.output_queue import Outgoing
from firmware_protocol.packets import PACKET_OVERHEAD_BYTES, SYNC
from firmware_protocol.states import BoardState
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.compatibility import gate_ticks
from resonator_daemon.board.session.connection import Connection
from resonator_daemon.board.session.frame_numbers import FrameNumbering
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import Arrival, Gap, LinkCounters, SingleToneFrame
from resonator_daemon.board.session.link_state import LinkState
from simulators.faults import FaultPlan
from simulators.faults.byte_faults import ByteFaults

GATE_NS = 1_000_000
FRAME_BYTES = PACKET_OVERHEAD_BYTES + CHANNEL_COUNT * SINGLE_TONE_STRUCT.size
PLATE = load_plate("quartz16")
GATE_TICKS = gate_ticks(PLATE)
RECORDS = bytes(CHANNEL_COUNT * SINGLE_TONE_STRUCT.size)
DESCRIPTION = Description(CounterKind.SINGLE_TONE, CHANNEL_COUNT, 1, 10**12, 1, 10**9, PLATE.name)
BEFORE_THE_WRAP = 2**32 - 1000


@dataclass(frozen=True)
class Case:
    """What goes wrong; rates are shares of the gates."""

    name: str
    plan: FaultPlan = field(default_factory=FaultPlan)
    overflow_rate: float = 0.0
    reboot_rate: float = 0.0
    hang_up_rate: float = 0.0  # for 1 to 300 gates
    chunk_bytes: int = 2000  # what a read gives at most; a draw from 1 up
    share: float = 1.0  # of the frames

    @property
    def damages(self) -> bool:
        return self.plan != FaultPlan()


RATES = {
    "bit_error_rate": 3e-6,
    "burst_rate_hz": 5.0,
    "garbage_rate_hz": 5.0,
    "duplicate_rate": 0.01,
    "reorder_rate": 0.01,
}
EVERYTHING = FaultPlan(**RATES, lost_chunk_rate_hz=5.0, lost_chunk_bytes=900)
CASES = (
    Case("nothing"),
    Case("one byte a read", FaultPlan(bit_error_rate=3e-5), chunk_bytes=1, share=0.02),
    Case("bit errors", FaultPlan(bit_error_rate=3e-5)),
    Case("bursts of 16 bits", FaultPlan(burst_rate_hz=50.0)),
    Case("garbage", FaultPlan(garbage_rate_hz=50.0)),
    Case("lost chunks", FaultPlan(lost_chunk_rate_hz=20.0, lost_chunk_bytes=900)),
    Case("duplicates", FaultPlan(duplicate_rate=0.02)),
    Case("pieces in the wrong order", FaultPlan(reorder_rate=0.02)),
    Case("board overflow", overflow_rate=0.02),
    Case("hang-ups", FaultPlan(bit_error_rate=1e-5), overflow_rate=0.005, hang_up_rate=1e-3),
    Case("reboots", reboot_rate=1e-3),
    Case("all together", EVERYTHING, overflow_rate=0.01, reboot_rate=3e-4, chunk_bytes=400),
)


class PerfectReader:
    """Who knows every packet that was sent finds those that are whole on the wire, each once, by comparing bytes.

    Damage may heal: a piece comes to lie next to the right neighbour, or two frames lose what leaves one of them whole.
    """

    def __init__(self) -> None:
        self.found: list[tuple[int, int]] = []  # boot id and ticks
        self._known: dict[bytes, tuple[int, int]] = {}
        self._stream = b""

    def knows(self, packet: bytes, boot_id: int, ticks: int) -> None:
        self._known[packet] = (boot_id, ticks)
        if len(self._known) > 100:
            del self._known[next(iter(self._known))]

    def read(self, data: bytes) -> None:
        stream, position = self._stream + data, 0
        while (start := stream.find(SYNC, position)) >= 0 and start + FRAME_BYTES <= len(stream):
            frame = self._known.pop(stream[start : start + FRAME_BYTES], None)
            if frame is not None:
                self.found.append(frame)
            position = start + (FRAME_BYTES if frame is not None else len(SYNC))
        self._stream = stream[max(position, len(stream) - FRAME_BYTES) :]


class Board:
    """Counts gates from a number just before the wrap, and keeps the list of what it sent unharmed."""

    def __init__(self, case: Case, seed: int) -> None:
        self._case = case
        self._random = np.random.default_rng(seed)
        self._faults = ByteFaults(case.plan, seed)
        self._boots = 0
        self.plugged_in = True
        self.heard = False  # frames of this boot have arrived
        self._reader = PerfectReader()
        self.arriving = self._reader.found  # the frames that must arrive
        self.sent = self.dropped = 0
        self.boot(0)

    def end_faults(self) -> None:
        self._case, self._faults = Case("the end"), ByteFaults(FaultPlan(), 0)

    def boot(self, now_ns: int) -> None:
        self._boots += 1
        self.boot_id = 1000 + self._boots
        self._boot_ns = now_ns
        self.session = DeviceSession(Identity("accounts", "A-1", "0", 0), DESCRIPTION, self.boot_id)
        self._runs = 0
        self._sequence = BEFORE_THE_WRAP
        self._since_start = self._reported = 0

    def gate(self, requests: bytes, now_ns: int) -> bytes:
        """Let one gate pass; return what is on the wire then."""
        if self._case.reboot_rate and self._random.random() < self._case.reboot_rate:
            self.boot(now_ns)
        ticks = now_ns - self._boot_ns
        outgoing = []
        if self.session.state is BoardState.RUNNING:
            outgoing += self._close_gate(ticks)
        answers = self.session.receive(requests, ticks)
        if self.session.started != self._runs:
            self._runs, self._sequence = self.session.started, BEFORE_THE_WRAP
            self._since_start = self._reported = 0
        if answers:
            outgoing.append(Outgoing(answers))
        return b"".join(self._on_the_wire(packets, ticks, now_ns) for packets in outgoing)

    def _close_gate(self, ticks: int) -> list[Outgoing]:
        sequence, self._sequence = self._sequence, (self._sequence + 1) % 2**32
        if self._case.overflow_rate and self._random.random() < self._case.overflow_rate:
            self._since_start += 1
            self.dropped += 1
            return []
        out = []
        if self._reported != self._since_start:
            self._reported = self._since_start
            status = self.session.status(BoardStatus(self._since_start), ticks)
            out.append(Outgoing(status))
        return [*out, Outgoing(self.session.frame(sequence, ticks, RECORDS), sequence)]

    def _on_the_wire(self, outgoing: Outgoing, ticks: int, now_ns: int) -> bytes:
        data = outgoing.data
        if self.heard:  # what comes as seldom as answers would be hit each time
            data, _ = self._faults.damage(data, now_ns * 1e-9)
        if not self.plugged_in:
            return b""
        if outgoing.is_frame:
            self.sent += 1
            self._reader.knows(outgoing.data, self.boot_id, ticks)
        self._reader.read(data)
        return data

    @property
    def hit(self) -> int:
        return self.sent - len(self.arriving)


class Receiver:
    """The daemon's end, and what arrived."""

    def __init__(self) -> None:
        self.account = LinkCounters()
        self.arrivals: list[Arrival] = []
        self._queue = FrameQueue(64 << 20, lambda: None)
        self._numbering = FrameNumbering(PLATE.frame_bytes, GATE_TICKS, GATE_NS)
        started = self._numbering.started

        def started_before_the_wrap(now_monotonic_ns: int) -> None:
            started(now_monotonic_ns)
            self._numbering._next_sequence = BEFORE_THE_WRAP  # noqa: SLF001 - 2^32 frames would take 50 days

        self._numbering.started = started_before_the_wrap  # type: ignore[method-assign]
        self._state = LinkState(self._queue.put)
        self.connection = Connection(
            PLATE, None, self._numbering, self._queue, self.account, self._state, _host_time(0)
        )
        self.fed_bytes = 0
        self.books_wrong = 0

    def open(self, now_ns: int) -> None:
        self.connection = Connection(
            PLATE, None, self._numbering, self._queue, self.account, self._state, _host_time(now_ns)
        )

    def take(self, data: bytes, now_ns: int) -> bytes:
        if data:
            self.fed_bytes += len(data)
            self.connection.receive(data, _host_time(now_ns))
        self.connection.run_timers(_host_time(now_ns), idle=True)
        self.arrivals += self._queue.pop_all()
        return self.connection.session.data_to_send()

    def check_bytes(self) -> None:
        now = self.account.copy()
        self.connection.add_to(now)
        fates = now.bytes_accepted + now.bytes_other_version + now.bytes_echo
        fates += now.bytes_discarded + now.bytes_waiting
        self.books_wrong += not now.bytes_received == self.fed_bytes == fates


def _host_time(now_ns: int) -> HostTime:
    return HostTime(now_ns, 10**18, 0)


def run(case: Case, gates: int, seed: int) -> list[str]:
    """Play a case; return what is wrong, in sentences."""
    board, receiver = Board(case, seed), Receiver()
    random = np.random.default_rng(seed + 1)
    now_ns, requests = 0, b""
    expected: list[tuple[int, int]] = []
    frames = gap_frames = next_index = out_of_order = 0
    boot_id = back = misplaced = 0
    first: tuple[int, int] | None = None  # index and ticks
    for number in range(gates + 50):
        now_ns += GATE_NS
        if number == gates:
            board.end_faults()  # the last frames tell of those before
        boots = receiver.account.boots
        board.heard = bool(boots) and boots[-1].boot_id == board.boot_id and boots[-1].frames > 0
        if case.hang_up_rate and board.plugged_in and number < gates and random.random() < case.hang_up_rate:
            board.plugged_in, back = False, number + int(random.integers(1, 300))
            receiver.connection.close()
            requests = b""
        elif not board.plugged_in and number >= back:
            board.plugged_in = True
            receiver.open(now_ns)
        data = board.gate(requests, now_ns)
        requests, at = b"", 0
        if not board.plugged_in:
            continue
        while at < len(data):
            size = int(random.integers(1, case.chunk_bytes + 1))
            requests += receiver.take(data[at : at + size], now_ns)
            at += size
            receiver.check_bytes()
        requests += receiver.take(b"", now_ns)
        for arrival in receiver.arrivals:
            if isinstance(arrival, Gap):
                out_of_order += arrival.first_index != next_index
                next_index += arrival.loss.total
                gap_frames += arrival.loss.total
            elif isinstance(arrival, SingleToneFrame):
                out_of_order += arrival.index != next_index
                next_index += 1
                boot_id = receiver.connection.described.boot_id if receiver.connection.described else 0
                expected.append((boot_id, arrival.board_ticks))
                first = first or (arrival.index, arrival.board_ticks)
                gates_on = (arrival.board_ticks - first[1]) // GATE_TICKS
                misplaced += not case.reboot_rate and arrival.index - first[0] != gates_on
                frames += 1
        receiver.arrivals.clear()
    sent, arrived, lost = set(board.arriving), set(expected), receiver.account.lost
    alone, total = not case.reboot_rate and not case.hang_up_rate, receiver.account.copy()
    receiver.connection.add_to(total)
    # Frames that were on the way before the board was asked anew are stale; the others must all be there.
    unexpected = expected != board.arriving if alone else len(sent - arrived) > total.messages_stale or arrived - sent
    boots = receiver.account.boots
    bits_only = case.plan.model_fields_set <= {"bit_error_rate", "burst_rate_hz"}
    findings = {
        f"{len(sent - arrived)} sound frames did not arrive, {len(arrived - sent)} others did": unexpected,
        f"account: {receiver.account.frames} frames, seen {frames}": receiver.account.frames != frames,
        f"account: {lost.total} lost, seen {gap_frames}": lost.total != gap_frames,
        "boot and link differ": not case.reboot_rate and (boots[0].frames, boots[0].lost) != (frames, lost),
        f"{misplaced} frames have another number than their ticks": misplaced,
        f"{lost.total} frames reported lost": alone and lost.total != board.dropped + board.hit,
        f"{lost.board_overflow} put down to the board, it dropped {board.dropped}": (
            not case.damages and not case.reboot_rate and lost.board_overflow != board.dropped
        ),
        f"{lost.damaged} put down to damage": bits_only and alone and lost.damaged != board.hit,
        f"{out_of_order} arrivals with another index than the next": out_of_order,
        f"bytes did not add up at {receiver.books_wrong} reads": receiver.books_wrong,
    }
    wrong = [f"{case.name}: {words}" for words, found in findings.items() if found]
    counts = f"{frames} frames, lost {lost.total} ({board.hit} hit, {board.dropped} dropped by the board)"
    print(f"{case.name}: {counts}, {receiver.fed_bytes} bytes: {'; '.join(wrong) or 'exact'}", flush=True)
    return wrong


def main() -> int:
    frames = int(float(sys.argv[1])) if len(sys.argv) > 1 else 10_000_000
    runs = [run(case, round(case.share * frames / len(CASES)), seed) for seed, case in enumerate(CASES)]
    return int(any(runs))


if __name__ == "__main__":
    sys.exit(main())
