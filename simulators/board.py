"""Firmware behaviour of an emulated board: bytes and ticks in, bytes out; no I/O, no clock."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from firmware_protocol.device import DeviceSession
from firmware_protocol.layouts import Capability
from firmware_protocol.messages import CounterKind, Identity, ResetCause
from firmware_protocol.output_queue import Outgoing, OutputQueue
from firmware_protocol.states import BoardState
from simulators.faults.byte_faults import packets_in
from simulators.faults.misbehaviour import Misbehaviour
from simulators.plate import Contact, CountedFrame, EmulatedPlate


class MadeFrame(NamedTuple):
    """A frame at the end of its gate, and what was true during it."""

    sequence: int
    board_ticks: int
    end_ticks: int  # the same moment, counted as `now_ticks`
    contacts: list[Contact]
    plate_kelvin: float


@dataclass(slots=True)
class _Run:
    """From one START to the next."""

    gate_ticks: int
    frames_packed: int = 0
    ahead: deque[tuple[MadeFrame, Outgoing]] = field(default_factory=deque)  # counted and packed, a block at once


class Board:
    """A board on a plate.

    `now_ticks` counts periods of the board's reference since the emulator began; the board itself counts from its last
    boot. The scenario begins at the first START ever and goes on through everything that happens to the board.

    Parameters
    ----------
    plate
        What the board counts.
    identity
        Identity that it reports; the cause of its last reset comes from `reboot`.
    boot_id
        Of the first boot.
    queue_limit_bytes
        Capacity of the output queue.
    drop_rate, seed
        Share of its frames that the board loses, drawn from that seed; it counts and reports them like the others.
    misbehaviour
        Deviations from the protocol.
    gate_ticks
        The only length of a gate that it offers; None: every one that the plate can be counted with.
    ahead_ticks
        Returns how long before its end a frame may be counted, but for the gate that is open; None: as suits the plate.

    Attributes
    ----------
    next_frame_ticks
        When the gate that is open closes, as `now_ticks`; None while the board does not count.
    """

    def __init__(
        self,
        plate: EmulatedPlate,
        identity: Identity,
        boot_id: int,
        queue_limit_bytes: int,
        *,
        drop_rate: float = 0.0,
        seed: int = 0,
        misbehaviour: Misbehaviour | None = None,
        gate_ticks: int | None = None,
        ahead_ticks: Callable[[], int] | None = None,
    ) -> None:
        self._plate = plate
        self._ahead_ticks = ahead_ticks
        self.single_tone = plate.description.counter_kind == CounterKind.SINGLE_TONE
        self._lies = misbehaviour or Misbehaviour()
        description = replace(plate.description, queue_bytes=queue_limit_bytes, capabilities=int(Capability.LOCATE))
        if gate_ticks is not None:
            description = replace(description, gate_ticks_min=gate_ticks, gate_ticks_max=gate_ticks)
        self._description = self._lies.description(description)
        self._queue_limit_bytes = queue_limit_bytes
        self._drop_rate = drop_rate
        self._random = np.random.default_rng(seed)
        self._boot_id = boot_id
        self.identity = self._lies.identity(identity)
        self.silent = False  # answers, and sends no frames
        self.first_start_ticks: int | None = None
        self.frames_made = 0
        self.frames_lost = 0  # by drop_rate
        self.frames_silenced = 0
        self.frames_crowded_out = 0  # of a full queue
        self._boot(0, ResetCause.POWER_ON)

    def reboot(self, boot_id: int, now_ticks: int, cause: ResetCause, *, serial_number: str | None = None) -> None:
        """Start again: idle, tick count and output empty; with another serial number as another board of its kind."""
        if serial_number is not None:
            self.identity = replace(self.identity, serial_number=serial_number)
        self._boot_id = self._lies.boot_id(boot_id, self._boot_id)
        self._boot(now_ticks, cause)

    def _boot(self, now_ticks: int, cause: ResetCause) -> None:
        self._boot_ticks = self._now_ticks = now_ticks
        self._ticks_to_step = 0
        self._session = DeviceSession(replace(self.identity, reset_cause=cause), self._description, self._boot_id)
        self._runs_begun = 0
        self._run: _Run | None = None
        self.next_frame_ticks: int | None = None
        self._queue = OutputQueue(self._session, self._queue_limit_bytes)

    def begin(self) -> None:
        """Become idle with an empty output, as a host's BEGIN asks for."""
        self._queue.begin()
        self.next_frame_ticks = None

    def host_connects(self, now_ticks: int, frames_cut: int = 0) -> bool:
        """Return whether to serve a new TCP connection, which ends the former one; if not, close the new one."""
        self._now_ticks = now_ticks
        return self._queue.host_connects(self._board_ticks, frames_cut)

    def connection_ended(self, frames_cut: int = 0) -> None:
        """Empty the output; `frames_cut`: frames that left the queue and did not go out whole. A run goes on."""
        self._queue.connection_ended(frames_cut)

    def step_ticks(self, ticks: int) -> None:
        """Shift the tick count; frames that are counted ahead still have the old one."""
        self._ticks_to_step += ticks
        if self.next_frame_ticks is None:
            self._step()

    def _step(self) -> None:
        self._boot_ticks -= self._ticks_to_step
        self._ticks_to_step = 0

    @property
    def running(self) -> bool:
        return self._session.state is BoardState.RUNNING

    @property
    def gate_ticks(self) -> int:
        """Length of a gate of the present or the last run; 0 before the first."""
        return 0 if self._run is None else self._run.gate_ticks

    @property
    def times_located(self) -> int:
        """How often the board was asked, since its boot, to make itself seen."""
        return self._session.located

    def receive(self, data: bytes, now_ticks: int) -> None:
        """Process bytes of the host. Call `advance` first: a frame whose gate has closed precedes the answer."""
        self._now_ticks = now_ticks
        answers = self._session.receive(data, self._board_ticks)
        configuration = self._session.configuration
        if self._session.started != self._runs_begun and configuration is not None:
            self._runs_begun = self._session.started
            self._begin_run(self._lies.gate_ticks(configuration.gate_ticks))
        elif not self.running:
            self.next_frame_ticks = None
        for answer in self._lies.answers(packets_in(answers)):
            self.frames_crowded_out += self._queue.put(Outgoing(answer))

    def advance(self, now_ticks: int) -> list[MadeFrame]:
        """Advance to this time; return the frames of all gates that have closed, which now wait for `next_output`."""
        self._now_ticks = now_ticks
        made: list[MadeFrame] = []
        while (run := self._run) is not None and (end := self.next_frame_ticks) is not None and end <= now_ticks:
            made.append(self._close_gate(run, end))
        return made

    def skip_gates(self, now_ticks: int, *, dropped: bool) -> int:
        """Close all gates until now without frames; return their number.

        With `dropped`, the board reports them as dropped; otherwise they count as sent, and never arrive.
        """
        self._now_ticks = now_ticks
        run, end_ticks = self._run, self.next_frame_ticks
        if run is None or end_ticks is None or end_ticks > now_ticks:
            return 0
        gates = (now_ticks - end_ticks) // run.gate_ticks + 1
        run.frames_packed += max(0, gates - len(run.ahead))
        for _ in range(min(gates, len(run.ahead))):
            run.ahead.popleft()
        if not dropped:
            self._queue.frames_taken += gates
        self.frames_made += gates
        self.next_frame_ticks = end_ticks + gates * run.gate_ticks
        return gates

    def count_ahead(self) -> None:
        """Count and pack the next frames ahead, so that they are ready when their gates close."""
        run, end_ticks = self._run, self.next_frame_ticks
        if run is None or run.ahead or end_ticks is None:
            return
        self._step()
        end_ticks -= run.gate_ticks
        board_ticks = end_ticks - self._boot_ticks
        scenario_ticks = end_ticks - (self.first_start_ticks or 0)
        frames = self._plate.block_frames
        if self._ahead_ticks is not None:
            frames = max(1, min(frames, self._ahead_ticks() // run.gate_ticks))
        for frame in self._plate.count(board_ticks, scenario_ticks, run.gate_ticks, frames):
            end_ticks += run.gate_ticks
            run.ahead.append(self._packed(frame, run.frames_packed, end_ticks))
            run.frames_packed += 1

    @property
    def frames_queued(self) -> int:
        return self._queue.frames

    def next_output(self) -> Outgoing | None:
        """Remove and return what goes out next."""
        return self._queue.take(self._now_ticks - self._boot_ticks)

    @property
    def _board_ticks(self) -> int:
        return self._now_ticks - self._boot_ticks

    def _begin_run(self, gate_ticks: int) -> None:
        if self.first_start_ticks is None:
            self.first_start_ticks = self._now_ticks
        self._queue.begin_run()
        self._run = _Run(gate_ticks)
        self.next_frame_ticks = self._now_ticks + gate_ticks
        self._plate.start()

    def _packed(self, counted: CountedFrame, sequence: int, end_ticks: int) -> tuple[MadeFrame, Outgoing]:
        board_ticks = end_ticks - self._boot_ticks
        if self.single_tone:
            data = self._session.frame(sequence, board_ticks, b"".join(counted.channels))
        else:
            data = self._session.frame_parts(sequence, board_ticks, counted.channels)
        made = MadeFrame(sequence, board_ticks, end_ticks, counted.contacts, counted.plate_kelvin)
        return made, Outgoing(data, sequence)

    def _close_gate(self, run: _Run, end_ticks: int) -> MadeFrame:
        if not run.ahead:
            self.count_ahead()
        made, outgoing = run.ahead.popleft()
        self.next_frame_ticks = end_ticks + run.gate_ticks
        self.frames_made += 1
        if self._drop_rate > 0.0 and self._random.random() < self._drop_rate:
            self.frames_lost += 1
        elif self.silent:
            self.frames_silenced += 1
        else:
            self.frames_crowded_out += self._queue.put(outgoing)
        return made
