"""One emulated board on a link in real time: the implementation of `resonatord emulate`."""

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
from pathlib import Path
from typing import Any, Literal, TextIO

from threadpoolctl import threadpool_limits

from firmware_protocol.layouts import PROTOCOL_MINOR
from firmware_protocol.messages import Identity, ResetCause
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from simulators.board import Board, MadeFrame
from simulators.comb_plate import CombPlate
from simulators.control import ControlSocket
from simulators.faults import FaultPlan
from simulators.faults.misbehaviour import Misbehaviour
from simulators.faults.script import Action, Script
from simulators.links import Link, PtyLink, TcpLink
from simulators.output import Output
from simulators.physics import Physics
from simulators.plate import EmulatedPlate
from simulators.presses import Presses
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import Scenario, load_scenario
from simulators.scenario_file import default_scenario
from simulators.truth import TruthOutput, truth_line
from simulators.world import World, with_world

SERIAL_NUMBER = "EMU-0001"
OTHER_SERIAL_NUMBER = "EMU-0002"  # of the board that is plugged in by mistake
SINGLE_TONE_QUEUE_BYTES = 256 * 1024  # 1.3 s of 204-byte frames at 1 kHz
CHANNELISED_QUEUE_BYTES = 16 * 1024 * 1024  # 1.1 s of 147 kB frames at 100 Hz
CREDIT_BYTES = 512  # a dozen requests
LATE_MAX_S = 2.0  # longer than the board's queue can bridge

_SPEED_MAX = 100.0
# Counted ahead where clients may press: the longer, the later a press shows; the shorter, the more processor time.
_HELD_AHEAD_S = 5e-3  # while one of them holds a touch
_RELEASED_AHEAD_S = 15e-3
_TRUTH_DELAY_NS = 10_000_000  # lines wait so long for others: a write costs as much as ten lines


@dataclass(frozen=True, slots=True)
class EmulatorOptions:
    """What to emulate, and where: a pseudo-terminal, a TCP address or an emulated USB device."""

    plate: str
    pty: Path | None = None
    tcp: tuple[str, int] | None = None
    usb: bool = False
    control: Path | None = None  # where clients may press the plate
    scenario: str | None = None  # None: the one that suits the plate, or no touch where clients may press it
    truth: Path | None = None
    faults: FaultPlan = field(default_factory=FaultPlan)  # in addition to the scenario's
    world: str = ""  # in what the plate differs from its file, besides the scenario's keys
    counter: Literal["sums", "stamps"] = "sums"  # of a single-tone plate: sums by closed form, or of every stamp
    seed: int | None = None  # None: the scenario's
    speed: float = 1.0
    frame_rate_hz: float | None = None  # the only one that the board offers; None: all that the plate allows
    json: bool = False


def run(options: EmulatorOptions) -> None:
    """Emulate until SIGINT, SIGTERM or SIGHUP; must be called in the main thread.

    Raises
    ------
    ValueError
        Options that contradict each other, or a scenario that does not fit the plate.
    ConfigurationError
        A plate that cannot be loaded.
    OSError
        The link or the truth file cannot be opened.
    """
    emulator = Emulator(options)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: emulator.stop())
    sys.stderr.write(f"emulating {options.plate} at {emulator.link.address}; stop with Ctrl-C\n")
    if emulator.environment:
        needed = " ".join(f"{name}={value}" for name, value in emulator.environment.items())
        sys.stderr.write(f"start the daemon with {needed}\n")
    if options.json:
        first: dict[str, Any] = {"link": emulator.link.address, "plate": emulator.plate_name}
        first["serial_number"] = SERIAL_NUMBER
        if emulator.environment:
            first["environment"] = emulator.environment
        if options.control:
            first["control"] = str(options.control)
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
        if (options.pty is not None) + (options.tcp is not None) + options.usb != 1:
            raise ValueError("an emulated board has one link: give one of pty, tcp and usb")
        if not 0.0 < options.speed <= _SPEED_MAX:
            raise ValueError(f"speed must be above 0 and at most {_SPEED_MAX:g}, got {options.speed:g}")
        plate = _at_rate(load_plate(options.plate), options.frame_rate_hz)
        presses = Presses(plate, SERIAL_NUMBER) if options.control else None
        usual = "still" if options.control else default_scenario(plate)
        scenario = load_scenario(options.scenario or usual, plate, presses)
        world = with_world(plate, options.world, scenario.world)
        faults = scenario.faults.with_more(options.faults)
        if options.pty is None and any(event.what == "rename" for event in faults.events):
            raise ValueError("faults: rename: only a pseudo-terminal has a name to change; give pty, or leave it out")
        scenario.physics = _skewed(world.with_oscillator_noise(scenario.physics), faults.skew_ppm)
        self.plate_name = plate.name
        seed = scenario.seed if options.seed is None else options.seed
        self._board = emulated_board(
            world,
            scenario,
            seed,
            options.counter,
            Misbehaviour(faults.misbehave),
            one_gate=options.frame_rate_hz is not None,
            presses=presses,
        )
        self._tick_rate_hz = plate.counter.reference_hz * (1.0 + scenario.physics.reference_error)
        self._ticks_per_ns = self._tick_rate_hz * options.speed * 1e-9
        self._truth_delay_ticks = _TRUTH_DELAY_NS * self._ticks_per_ns
        self._late_ticks = LATE_MAX_S * self._tick_rate_hz
        self._frames_too_late = 0
        self._made: list[MadeFrame] = []  # whose truth has not been written
        self._newest: MadeFrame | None = None
        self._script = Script(faults, seed)
        self._stopping = False
        self.environment: dict[str, str] = {}  # what a host must be started with to see the link
        with ExitStack() as stack:
            self._wake_read_fd, self._wake_write_fd = os.pipe()
            stack.callback(os.close, self._wake_read_fd)
            stack.callback(os.close, self._wake_write_fd)
            self._truth = stack.enter_context(closing(TruthOutput(options.truth))) if options.truth else None
            self._control: ControlSocket | None = None
            if options.control is not None and presses is not None:
                presses.truth = self._newest_truth
                self._control = stack.enter_context(closing(ControlSocket(options.control, presses)))
            self.link = self._open_link(options, 10 * plate.frame_bytes * plate.counter.frame_rate_hz)
            stack.callback(self.link.close)
            self._resources = stack.pop_all()
        self._output = Output(self._board, self.link, faults, seed)

    def run(self) -> None:
        """Emulate until `stop`, then close link and files."""
        # A second thread of the linear algebra would only spin.
        with self._resources, threadpool_limits(1):
            self._origin_ns = time.monotonic_ns()
            board, output, readable = self._board, self._output, False
            while not self._stopping:
                if self._script.next_s is not None:
                    self._follow_script(self._now_ticks())
                data = self.link.read() if readable else b""
                now_ns = time.monotonic_ns() - self._origin_ns
                now_ticks = int(now_ns * self._ticks_per_ns)  # at which a request came
                self._skip_late(now_ticks)
                made = board.advance(now_ticks)
                if data:
                    self._receive(data, now_ticks)
                output.send(now_ns, 0.0 if output.faultless else self._elapsed_s(now_ticks))
                if made:
                    self._made += made
                    self._newest = made[-1]
                    self._write_truth()
                board.count_ahead()
                readable = self._wait()
            self._write_truth()

    def _skip_late(self, now_ticks: int) -> None:
        """Drop the due frames if they are more than LATE_MAX_S late: computing them all would increase the delay."""
        due_ticks = self._board.next_frame_ticks
        if due_ticks is not None and now_ticks - due_ticks > self._late_ticks:
            self._frames_too_late += self._board.skip_gates(now_ticks, dropped=True)

    def stop(self) -> None:
        """End `run`; from any thread or signal handler."""
        if not self._stopping:  # later the pipe may be closed
            os.write(self._wake_write_fd, b"x")  # before the flag: a run that has seen it closes the pipe
            self._stopping = True

    def report(self) -> dict[str, Any]:
        """Return what was sent and what was done to it; every frame made was sent, dropped or is still unsent."""
        board, output = self._board, self._output
        unsent = board.frames_queued + output.frames_unsent
        dropped = board.frames_made - output.frames_sent - unsent
        by_cause = {
            "drop_rate": board.frames_lost,
            "queue_full": board.frames_crowded_out,
            "silence": board.frames_silenced,
            "too_late": self._frames_too_late,
        }
        return {
            "frames_made": board.frames_made,
            "frames_sent": output.frames_sent,
            "frames_dropped": dropped,
            # Discarded: the host was gone (not detected on a terminal), or the board rebooted or began another run.
            "dropped_by_cause": by_cause | {"discarded": dropped - sum(by_cause.values())},
            "frames_unsent": unsent,
            "bytes_sent": output.bytes_sent,
            "truth_lines_lost": self._truth.lines_lost if self._truth else 0,
            "faults": asdict(output.counts),
        }

    def _open_link(self, options: EmulatorOptions, bits_per_s: float) -> Link:
        if options.pty is not None:
            self._pty = PtyLink(options.pty, bits_per_s)
            return self._pty
        if options.tcp is not None:
            return TcpLink(*options.tcp, lambda: self._output.host_connects(self._now_ticks()))
        from simulators.usb_link import UsbLink

        usb = UsbLink(SERIAL_NUMBER, self._begin)
        self.environment = usb.environment
        return usb

    def _begin(self) -> None:
        self._board.begin()
        self._output.clear()

    def _now_ticks(self) -> int:
        return int((time.monotonic_ns() - self._origin_ns) * self._ticks_per_ns)

    def _elapsed_s(self, now_ticks: int) -> float:
        """Time since the first START, 0 before it."""
        start_ticks = self._board.first_start_ticks
        return 0.0 if start_ticks is None else (now_ticks - start_ticks) / self._tick_rate_hz

    @property
    def _next_step_ticks(self) -> int | None:
        next_s, start_ticks = self._script.next_s, self._board.first_start_ticks
        if next_s is None or start_ticks is None:
            return None
        return start_ticks + math.ceil(next_s * self._tick_rate_hz)

    def _follow_script(self, now_ticks: int) -> None:
        # One step at a time, so that an unplugged link is detected before it is back.
        if (due_ticks := self._next_step_ticks) is None or due_ticks > now_ticks:
            return
        step = self._script.pop()
        counts = self._output.counts
        match step.action:
            case Action.UNPLUG:
                counts.unplugs += 1
                self.link.hang_up()
            case Action.PLUG_IN:
                self.link.plug_in()
            case Action.RENAME:
                counts.renames += 1
                self._pty.rename(step.to)
            case Action.FREEZE:
                counts.freezes += 1
                self._output.held = True
            case Action.THAW:
                self._output.held = False
            case Action.SILENCE:
                counts.silences += 1
                self._board.silent = True
            case Action.RESUME:
                self._board.silent = False
            case Action.REBOOT:
                counts.reboots += 1
                self._output.clear()
                self._reboot(ResetCause.SOFTWARE)
            case Action.BROWN_OUT:
                counts.brown_outs += 1
                self._output.cut_next_frame(lambda: self._reboot(ResetCause.BROWN_OUT))
            case Action.STEP_TICKS:
                counts.tick_steps += 1
                self._board.step_ticks(step.ticks)
            case Action.TAKE_AWAY:
                self.link.hang_up()
            case Action.PLUG_IN_OTHER:
                counts.wrong_boards += 1
                self._reboot(ResetCause.POWER_ON, OTHER_SERIAL_NUMBER)
                self.link.plug_in()
            case Action.PLUG_IN_OWN:
                self._reboot(ResetCause.POWER_ON, SERIAL_NUMBER)
                self.link.plug_in()

    def _reboot(self, cause: ResetCause, serial_number: str | None = None) -> None:
        self._board.reboot(_draw_boot_id(), self._now_ticks(), cause, serial_number=serial_number)

    def _receive(self, data: bytes, now_ticks: int) -> None:
        located = self._board.times_located
        self._board.receive(data, now_ticks)
        if self._board.times_located > located:
            sys.stderr.write(f"board {self._board.identity.serial_number} blinks\n")

    def _write_truth(self) -> None:
        """Write the truth of the frames made, unless the next frame ends within 10 ms of the oldest one."""
        made, next_ticks = self._made, self._board.next_frame_ticks
        if not made:
            return
        wait_ticks = made[0].end_ticks + self._truth_delay_ticks
        if next_ticks is not None and next_ticks < wait_ticks and not self._stopping:
            return
        self._made = []
        if self._truth is None:
            return
        self._truth.write("".join(self._truth_lines(made)))

    def _truth_lines(self, made: list[MadeFrame]) -> list[str]:
        to_utc_ns = self._origin_ns + time.time_ns() - time.monotonic_ns()
        return [truth_line(frame, round(frame.end_ticks / self._ticks_per_ns) + to_utc_ns) for frame in made]

    def _newest_truth(self) -> dict[str, Any] | None:
        """Return the truth of the newest frame as an object, with the middle of its gate; None before the first."""
        if self._newest is None:
            return None
        truth: dict[str, Any] = json.loads(self._truth_lines([self._newest])[0])
        half_gate_ns = self._board.gate_ticks / self._ticks_per_ns / 2.0
        return truth | {"gate_middle_t_ns": str(int(truth["t_ns"]) - round(half_gate_ns))}

    def _wait(self) -> bool:
        """Wait for what is due next, for the link or for `stop`; return whether the link has something to read."""
        link, output = self.link, self._output
        room_wanted, output_ns = output.waits_for()
        writers = [link.write_fd] if room_wanted and link.write_fd is not None else []
        of_link = [] if output.held else link.read_fds
        readers = [self._wake_read_fd, *of_link]
        if self._control is not None:
            readers += self._control.read_fds
            writers += self._control.write_fds
        due_ns = math.inf
        if (frame_ticks := self._board.next_frame_ticks) is not None:
            due_ns = frame_ticks / self._ticks_per_ns
        if self._script.next_s is not None and (step_ticks := self._next_step_ticks) is not None:
            due_ns = min(due_ns, step_ticks / self._ticks_per_ns)
        if output_ns is not None and link.write_fd is not None:
            due_ns = min(due_ns, output_ns)
        wait_s = (self._origin_ns + due_ns - time.monotonic_ns()) * 1e-9
        readable, writable, _ = select.select(readers, writers, [], None if wait_s == math.inf else max(wait_s, 0.0))
        if self._control is not None:
            self._control.serve({*readable, *writable})
        return bool(readable) and any(fd in of_link for fd in readable)


def _draw_boot_id() -> int:
    """Return a number for a start of a board: never the same for a given seed, or a restart would go unnoticed."""
    return secrets.randbelow(0xFFFFFFFF) + 1


def _at_rate(plate: Plate, frame_rate_hz: float | None) -> Plate:
    """Return the plate with that frame rate in place of its own."""
    if frame_rate_hz is None:
        return plate
    counter = plate.counter.model_copy(update={"frame_rate_hz": frame_rate_hz})
    return plate.model_copy(update={"counter": counter})


def emulated_board(
    world: World,
    scenario: Scenario,
    seed: int,
    counter: Literal["sums", "stamps"],
    misbehaviour: Misbehaviour,
    *,
    one_gate: bool = False,
    presses: Presses | None = None,
) -> Board:
    """Return a board on the plate, as `Board`; with `one_gate` it offers no other frame rate than the plate's."""
    plate = world.plate
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
        from simulators.skin_plate import SkinPlate  # here: its splines are slow to import, and few plates have a skin

        emulated = SkinPlate(world, scenario, seed, reference_error=scenario.physics.reference_error)
    gate_ticks = None
    if one_gate:
        gate_ticks = round(plate.counter.reference_hz / plate.counter.frame_rate_hz)
        low, high = emulated.description.gate_ticks_min, emulated.description.gate_ticks_max
        if not low <= gate_ticks <= high:
            lowest_hz, highest_hz = plate.counter.reference_hz / high, plate.counter.reference_hz / low
            raise ValueError(
                f"frame_rate_hz: got {plate.counter.frame_rate_hz:g}; the emulated {plate.name} makes {lowest_hz:g} to "
                f"{highest_hz:g} frames/s"
            )

    def ahead_ticks() -> int:
        ahead_s = _HELD_AHEAD_S if presses is not None and presses.held else _RELEASED_AHEAD_S
        return round(ahead_s * plate.counter.reference_hz)

    return Board(
        emulated,
        Identity(f"emulated {plate.name}", SERIAL_NUMBER, "emulator", PROTOCOL_MINOR, CREDIT_BYTES),
        _draw_boot_id(),
        SINGLE_TONE_QUEUE_BYTES if single_tone else CHANNELISED_QUEUE_BYTES,
        drop_rate=scenario.physics.drop_rate,
        seed=seed,
        misbehaviour=misbehaviour,
        gate_ticks=gate_ticks,
        ahead_ticks=None if presses is None else ahead_ticks,
    )


def _skewed(physics: Physics, skew_ppm: float) -> Physics:
    error = (1.0 + physics.reference_error) * (1.0 + skew_ppm * 1e-6) - 1.0
    return physics.model_copy(update={"reference_error": error}) if skew_ppm else physics


def _write_line(stream: TextIO, value: dict[str, Any]) -> None:
    stream.write(json.dumps(value) + "\n")
    stream.flush()
