"""A board and the daemon's end of its link in simulated time: what takes seconds on a wire takes none here."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace

from listener import Arrivals, check_indices

from firmware_protocol.device import DeviceSession
from firmware_protocol.host import Described
from firmware_protocol.messages import CounterKind, Description, Identity
from firmware_protocol.states import BoardState
from resonator_daemon.base.host.load import NO_LOAD
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.compatibility import gate_ticks
from resonator_daemon.board.session.connection import Connection
from resonator_daemon.board.session.frame_numbers import FrameNumbering
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.frames import LinkCounters
from resonator_daemon.board.session.link_state import LinkState

PLATE = load_plate("quartz16")
GATE_TICKS = gate_ticks(PLATE)
MS = 1_000_000
STEP_NS = MS // 2
IDENTITY = Identity("test board", "T-1", "1.0", 0, credit_bytes=128)
DESCRIPTION = Description(
    counter_kind=CounterKind.SINGLE_TONE, channels=4, tones=1, reference_millihertz=10**12, gate_ticks_min=100_000,
    gate_ticks_max=1_000_000_000, plate="quartz16"
)  # fmt: skip


class SimulatedBoard:
    """A board of 1 GHz that counts nothing; `fast_ppm` is its reference's error, `slip` bends what it sends."""

    def __init__(self, identity: Identity = IDENTITY, description: Description = DESCRIPTION, boot_id: int = 7) -> None:
        self.identity, self.description = identity, description
        self.fast_ppm = 0.0
        self.silent = False  # sends no frames
        self.frozen = False  # nor anything else
        self.jump_ticks = 0
        self.slip: Callable[[bytes], bytes] = bytes
        self.slip_answer: Callable[[bytes], bytes] = bytes
        self.boot(boot_id, 0)

    def boot(self, boot_id: int, now_ns: int) -> None:
        self.session = DeviceSession(self.identity, self.description, boot_id)
        self._boot_ns = now_ns
        self._gate_end = 0
        self._sequence = 0
        self._runs = 0
        self.jump_ticks = 0

    def ticks(self, now_ns: int) -> int:
        return round((now_ns - self._boot_ns) * (1 + self.fast_ppm * 1e-6)) + self.jump_ticks

    def step(self, data: bytes, now_ns: int) -> bytes:
        """Process what the host sent; return what goes out by then."""
        if self.frozen:
            return b""
        out = self._frames(now_ns)
        answers = self.session.receive(data, self.ticks(now_ns))
        if self.session.started != self._runs:
            self._runs = self.session.started
            self._gate_end, self._sequence = self.ticks(now_ns), 0
        return out + self.slip_answer(answers)

    def skip_gates(self, now_ns: int) -> None:
        """Count the gates that have closed by now without sending their frames."""
        silent, self.silent = self.silent, True
        self._frames(now_ns)
        self.silent = silent

    def _frames(self, now_ns: int) -> bytes:
        out = b""
        configuration = self.session.configuration
        if self.session.state is not BoardState.RUNNING or configuration is None:
            return out
        while self._gate_end + configuration.gate_ticks + self.jump_ticks <= self.ticks(now_ns):
            self._gate_end += configuration.gate_ticks
            if not self.silent:
                out += self.slip(self.session.frame(self._sequence, self._gate_end + self.jump_ticks, bytes(176)))
            self._sequence += 1
        return out


class Bench(Arrivals):
    """One daemon's end over any number of connections, and the time."""

    def __init__(self, board: SimulatedBoard, delay_ns: int = 0, step_ns: int = STEP_NS, plate: Plate = PLATE) -> None:
        self.board = board
        self.plate = plate
        self.delay_ns = delay_ns  # from board to host
        self.step_ns = step_ns
        self.now_ns = 10_000 * MS
        self.utc_step_ns = self.slept_ns = 0
        self.queue = FrameQueue(64 << 20, lambda: None)
        self.numbering = FrameNumbering(PLATE.frame_bytes, GATE_TICKS, MS)
        self.total = LinkCounters()
        self.state = LinkState(self.queue.put)
        self.known: Described | None = None
        self.arrivals = []
        self.load = NO_LOAD  # of the host
        self.connection: Connection
        self.open()

    def open(self) -> None:
        self._on_the_way: deque[tuple[int, bytes]] = deque()
        self.connection = Connection(
            self.plate, self.known, self.numbering, self.queue, self.total, self.state, self.host_time()
        )

    def close(self) -> None:
        if self.connection.was_online:
            self.known = self.connection.described
        self.connection.close()
        self.arrivals += self.queue.pop_all()

    def reopen(self, after_ms: float = 0.0) -> None:
        self.close()
        self.now_ns += round(after_ms * MS)
        self.open()

    def host_time(self) -> HostTime:
        return HostTime(self.now_ns, 10**18 + self.utc_step_ns + self.slept_ns, self.slept_ns)

    def run(self, ms: float) -> None:
        """Let time pass; raises what the connection raises."""
        for _ in range(round(ms * MS / self.step_ns)):
            self.now_ns += self.step_ns
            out = self.board.step(self.connection.session.data_to_send(), self.now_ns)
            if out:
                self._on_the_way.append((self.now_ns + self.delay_ns, out))
            data = b""
            while self._on_the_way and self._on_the_way[0][0] <= self.now_ns:
                data += self._on_the_way.popleft()[1]
            if data:
                self.connection.receive(data, self.host_time())
            self.connection.run_timers(self.host_time(), idle=not data, sample=self.load)
        self.arrivals += self.queue.pop_all()

    @property
    def counters(self) -> LinkCounters:
        counters = self.total.copy()
        self.connection.add_to(counters)
        return counters

    def check_indices(self) -> None:
        check_indices(self.arrivals)


def board(**changes: object) -> SimulatedBoard:
    """Return a board whose description differs in this."""
    return SimulatedBoard(description=replace(DESCRIPTION, **changes))  # type: ignore[arg-type]


def online(**changes: object) -> Bench:
    """Return a bench whose board, described so, has been counting for a while."""
    bench = Bench(board(**changes))
    bench.run(200)
    assert bench.states[-1][0] == "online"
    return bench
