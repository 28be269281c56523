"""Runs one emulated board on a link in real time: what `resonatord emulate` calls."""

import json
import math
import os
import secrets
import select
import signal
import sys
import time
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Literal, TextIO

from threadpoolctl import threadpool_limits

from firmware_protocol.layouts import PROTOCOL_MINOR
from firmware_protocol.messages import Identity
from resonator_daemon.plate import FORCE_SIGNAL, Plate, load_plate
from simulators.board import Board
from simulators.comb_plate import CombPlate
from simulators.faults import FaultInjector, FaultPlan
from simulators.links import Link, PtyLink, TcpLink
from simulators.plate import EmulatedPlate
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import Scenario, load_scenario
from simulators.scenario_file import default_scenario
from simulators.skin_plate import SkinPlate
from simulators.truth import TruthOutput, truth_line

SERIAL_NUMBER = "EMU-0001"
SINGLE_TONE_QUEUE_BYTES = 256 * 1024  # 1.3 s of 204-byte frames at 1 kHz
CHANNELISED_QUEUE_BYTES = 16 * 1024 * 1024  # 1.1 s of 147 kB frames at 100 Hz

_SPEED_MAX = 100.0


class _Event(Enum):
    UNPLUG = "unplug"
    PLUG_IN = "plug in"
    REBOOT = "reboot"


@dataclass(frozen=True, slots=True)
class EmulatorOptions:
    """What to emulate, and where: either a pseudo-terminal or a TCP address."""

    plate: str
    pty: Path | None = None
    tcp: tuple[str, int] | None = None
    scenario: str | None = None  # None: the one that suits the plate
    truth: Path | None = None
    faults: FaultPlan = field(default_factory=FaultPlan)
    counter: Literal["sums", "stamps"] = "sums"  # of a single-tone plate: sums by closed form, or of every stamp
    seed: int | None = None  # None: the scenario's
    speed: float = 1.0
    json: bool = False


def run(options: EmulatorOptions) -> None:
    """Emulate until SIGINT, SIGTERM or SIGHUP; must be called in the main thread.

    Raises
    ------
    ValueError
        Options that contradict each other, or a scenario that does not fit the plate.
    ConfigError
        A plate that cannot be loaded.
    OSError
        The link or the truth file cannot be opened.
    """
    emulator = Emulator(options)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: emulator.stop())
    sys.stderr.write(f"emulating {options.plate} at {emulator.link.address}; stop with Ctrl-C\n")
    if options.json:
        first = {"link": emulator.link.address, "plate": emulator.plate_name, "serial_number": SERIAL_NUMBER}
        _write_line(sys.stdout, first)
    emulator.run()
    report = emulator.report()
    frames = ", ".join(f"{report[f'frames_{what}']} {what}" for what in ("made", "sent", "dropped", "unsent"))
    faults = ", ".join(f"{key} {count}" for key, count in report["faults"].items() if isinstance(count, int) and count)
    sys.stderr.write(f"frames: {frames}; faults: {faults or 'none'}\n")
    if options.json:
        _write_line(sys.stdout, report)


class Emulator:
    """One board, one link, one thread; the truth goes to a file, never over the link."""

    def __init__(self, options: EmulatorOptions) -> None:
        if (options.pty is None) == (options.tcp is None):
            raise ValueError("an emulated board has one link: give either pty or tcp")
        if not 0.0 < options.speed <= _SPEED_MAX:
            raise ValueError(f"speed must be above 0 and at most {_SPEED_MAX:g}, got {options.speed:g}")
        plate = load_plate(options.plate)
        scenario = load_scenario(options.scenario or default_scenario(plate), plate)
        self.plate_name = plate.name
        seed = scenario.seed if options.seed is None else options.seed
        self._board = _emulated_board(plate, scenario, seed, options.counter)
        self._tick_rate_hz = plate.counter.reference_hz * (1.0 + scenario.physics.reference_error)
        self._ticks_per_ns = self._tick_rate_hz * options.speed * 1e-9
        self._injector = FaultInjector(options.faults, seed)
        self._script = _script(options.faults)
        self._unsent = memoryview(b"")  # of what is being sent; whole once empty
        self._unsent_is_frame = False
        self._frames_sent = 0
        self._bytes_sent = 0
        self._stopping = False
        with ExitStack() as stack:
            self._wake_read_fd, self._wake_write_fd = os.pipe()
            stack.callback(os.close, self._wake_read_fd)
            stack.callback(os.close, self._wake_write_fd)
            self._truth = stack.enter_context(closing(TruthOutput(options.truth))) if options.truth else None
            self.link: Link = PtyLink(options.pty) if options.pty else TcpLink(*(options.tcp or ("", 0)))
            stack.callback(self.link.close)
            self._resources = stack.pop_all()

    def run(self) -> None:
        """Emulate until `stop`, then let go of link and files."""
        # A second thread of the linear algebra would only spin.
        with self._resources, threadpool_limits(1):
            self._origin_ns = time.monotonic_ns()
            readable = False
            while not self._stopping:
                now_ticks = int((time.monotonic_ns() - self._origin_ns) * self._ticks_per_ns)
                self._follow_script(now_ticks)
                self._advance(now_ticks)
                if readable and (data := self.link.read()):
                    self._board.receive(data, now_ticks)
                self._send(now_ticks)
                self._board.count_ahead()
                readable = self._wait()

    def stop(self) -> None:
        """End `run`; from any thread or signal handler."""
        if not self._stopping:  # later the pipe may be closed
            os.write(self._wake_write_fd, b"x")  # before the flag: a run that has seen it closes the pipe
            self._stopping = True

    def report(self) -> dict[str, Any]:
        """Return what was sent and what was done to it; every frame made was sent, dropped or is still unsent."""
        board = self._board
        unsent = board.frames_queued + (len(self._unsent) > 0 and self._unsent_is_frame)
        dropped = board.frames_made - self._frames_sent - unsent
        return {
            "frames_made": board.frames_made,
            "frames_sent": self._frames_sent,
            "frames_dropped": dropped,
            "dropped_by_cause": {
                "drop_rate": board.frames_lost,
                "queue_full": board.frames_crowded_out,
                "discarded": dropped - board.frames_lost - board.frames_crowded_out,  # host gone, reboot or new run
            },
            "frames_unsent": unsent,
            "bytes_sent": self._bytes_sent,
            "truth_lines_lost": self._truth.lines_lost if self._truth else 0,
            "faults": asdict(self._injector.counts),
        }

    def _elapsed_s(self, now_ticks: int) -> float | None:
        """Time since the first START, None before it."""
        start_ticks = self._board.first_start_ticks
        return None if start_ticks is None else (now_ticks - start_ticks) / self._tick_rate_hz

    @property
    def _next_event_ticks(self) -> int | None:
        start_ticks = self._board.first_start_ticks
        if not self._script or start_ticks is None:
            return None
        return start_ticks + math.ceil(self._script[0][0] * self._tick_rate_hz)

    def _follow_script(self, now_ticks: int) -> None:
        # One event at a time, so that everyone notices an unplugged link before it is back.
        if (due_ticks := self._next_event_ticks) is not None and due_ticks <= now_ticks:
            _, event = self._script.pop(0)
            match event:
                case _Event.UNPLUG:
                    self._injector.counts.unplugs += 1
                    self.link.hang_up()
                case _Event.PLUG_IN:
                    self.link.plug_in()
                case _Event.REBOOT:
                    self._injector.counts.reboots += 1
                    self._unsent = memoryview(b"")
                    self._board.reboot(_draw_boot_id(), now_ticks)

    def _advance(self, now_ticks: int) -> None:
        frames = self._board.advance(now_ticks)
        if self._truth is not None and frames:
            utc_less_monotonic_ns = time.time_ns() - time.monotonic_ns()
            for frame in frames:
                end_ns = self._origin_ns + round(frame.end_ticks / self._ticks_per_ns)
                self._truth.write(truth_line(frame, end_ns + utc_less_monotonic_ns))

    def _send(self, now_ticks: int) -> None:
        while self.link.write_fd is not None:
            if not self._unsent:
                if (outgoing := self._board.next_output()) is None:
                    return
                self._unsent = memoryview(self._injector.damage(outgoing, self._elapsed_s(now_ticks) or 0.0))
                self._unsent_is_frame = outgoing.is_frame
            written = self.link.write(self._unsent)
            self._bytes_sent += written
            self._unsent = self._unsent[written:]
            if not self._unsent:
                self._injector.sent()
                self._frames_sent += self._unsent_is_frame
            elif self.link.write_fd is not None:
                return  # the host does not take more now
        self._lose_output()

    def _lose_output(self) -> None:
        """Nobody will ever read what was meant for a host that is gone."""
        self._unsent = memoryview(b"")
        self._board.discard_output()

    def _wait(self) -> bool:
        """Wait for the next gate to close, for the link or for `stop`; tell whether the link has something to read."""
        write_fd = self.link.write_fd
        writers = [write_fd] if write_fd is not None and self._unsent else []
        due_ticks = [due for due in (self._board.next_frame_ticks, self._next_event_ticks) if due is not None]
        wait_s = None
        if due_ticks:
            due_ns = self._origin_ns + min(due_ticks) / self._ticks_per_ns
            wait_s = max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)
        readable, _, _ = select.select([self._wake_read_fd, *self.link.read_fds], writers, [], wait_s)
        return any(fd != self._wake_read_fd for fd in readable)


def _draw_boot_id() -> int:
    """Return a number for a start of a board: never the same for a given seed, or a restart would go unnoticed."""
    return secrets.randbelow(0xFFFFFFFF) + 1


def _emulated_board(plate: Plate, scenario: Scenario, seed: int, counter: Literal["sums", "stamps"]) -> Board:
    single_tone = plate.counter.kind == "single-tone"
    emulated: EmulatedPlate
    if counter == "stamps" and not single_tone:
        raise ValueError(
            f"counter: got stamps; plate {plate.name} is channelised, and only a single-tone counter makes stamps; "
            "leave it out"
        )
    if single_tone:
        emulated = QuartzPlate(plate, scenario, seed, counter=counter)
    elif FORCE_SIGNAL in plate.signals:
        emulated = CombPlate(plate, scenario, seed)
    else:
        emulated = SkinPlate(plate, scenario, seed, reference_error=scenario.physics.reference_error)
    return Board(
        emulated,
        Identity(f"emulated {plate.name}", SERIAL_NUMBER, "emulator", PROTOCOL_MINOR),
        _draw_boot_id(),
        SINGLE_TONE_QUEUE_BYTES if single_tone else CHANNELISED_QUEUE_BYTES,
        drop_rate=scenario.physics.drop_rate,
        seed=seed,
    )


def _script(plan: FaultPlan) -> list[tuple[float, _Event]]:
    """Return what happens when, in order; seconds since the first START."""
    events = []
    if plan.unplug_at_s is not None:
        events.append((plan.unplug_at_s, _Event.UNPLUG))
        events.append((plan.unplug_at_s + plan.unplug_for_s, _Event.PLUG_IN))
    if plan.reboot_at_s is not None:
        events.append((plan.reboot_at_s, _Event.REBOOT))
    return sorted(events, key=lambda event: event[0])


def _write_line(stream: TextIO, value: dict[str, Any]) -> None:
    stream.write(json.dumps(value) + "\n")
    stream.flush()
