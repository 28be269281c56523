"""What the stages from bytes to forces, messages and files cost, and the start of the daemon, for `stages.py`."""

import asyncio
import itertools
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from zlib import crc32

import numpy as np
import psutil
from lz4.frame import decompress
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from parts import COMMAND, START_S, broker
from stages import Stage, Work
from system_cost import record_quartz

from firmware_protocol.device import DeviceSession
from firmware_protocol.layouts import CHANNEL_COUNT, SINGLE_TONE_STRUCT
from firmware_protocol.messages import CounterKind, Description, Identity
from firmware_protocol.packets import PacketDecoder
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.writer import RecordingWriter
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.link_events import Received
from resonator_daemon.estimate.forces.site_identification import Matcher
from resonator_daemon.estimate.tones.tone_detector import capture_band_hz
from resonator_daemon.estimate.tones.tone_windows import ToneWindows
from resonator_daemon.measure.sensors.plate_sites import force_sites
from resonator_daemon.measure.sensors.single_tone_processing import SingleToneProcessing
from resonator_daemon.mqtt.codec import Outgoing, encode
from resonator_daemon.mqtt.message_examples import EXAMPLES
from resonator_daemon.mqtt.payloads import Forces, Lost
from resonator_daemon.mqtt.publisher import Publisher
from resonator_daemon.mqtt.topics import Topic
from resonator_daemon.tools.replay.recorded_pipeline import open_replay
from simulators.physics import Physics
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import Scenario
from simulators.scenario_file import Touch

STEP = 5  # frames that the daemon takes at once
SETTLED, USED = 200, 400  # frames of the scene
MESSAGES, AT_ONCE = 200, 10
RECORDED_S, END_S = 3.0, 30.0
PLATE = load_plate("quartz16")
GATE_TICKS = round(PLATE.counter.reference_hz / PLATE.counter.frame_rate_hz)
TOUCH = Touch(start_s=0.15, site=4, force_newton=2.0, rise_s=0.01, hold_s=1e6)
BARE = "import numpy, pydantic, paho.mqtt.client"


def steps_of(payloads: list[bytes]) -> list[bytes]:
    return [b"".join(payloads[at : at + STEP]) for at in range(0, len(payloads), STEP)]


def touched_frames() -> tuple[list[bytes], list[bytes]]:
    """Return steps of five frames of quartz16, until the baseline is known and from then on, with one touch."""
    scenario = Scenario([TOUCH], None, PLATE, physics=Physics(), environment_kelvin=((0.0, 298.15),))
    plate, counted = QuartzPlate(PLATE, scenario, 0), []
    for first in range(0, SETTLED + USED, 40):
        ticks = first * GATE_TICKS
        counted += [b"".join(frame.channels) for frame in plate.count(ticks, ticks, GATE_TICKS, 40)]
    return steps_of(counted[:SETTLED]), steps_of(counted[SETTLED:])


def framing() -> Stage:
    identity, description = (
        Identity("bench", "0", "0", 0),
        Description(CounterKind.SINGLE_TONE, CHANNEL_COUNT, 1, 1, 1, 9, ""),
    )
    session, size = DeviceSession(identity, description, 1), CHANNEL_COUNT * SINGLE_TONE_STRUCT.size
    packets = [session.frame(number, number, os.urandom(size)) for number in range(40 * STEP)]
    reads, decoder = steps_of(packets), PacketDecoder(from_board=True)
    return Stage(
        "framing",
        Work("", lambda: [decoder.feed(read) for read in reads], len(packets)),
        Work("zlib.crc32 of each frame", lambda: [crc32(packet) for packet in packets], len(packets)),
    )


def numbers_of(steps: list[bytes]) -> Work:
    """Return the work that any Python program does with records."""

    def run() -> None:
        for payload in steps:
            [record[4] / record[2] for record in SINGLE_TONE_STRUCT.iter_unpack(payload)]

    return Work("struct.unpack and one division for each record", run, USED)


def frequency_estimation(steps: list[bytes]) -> Stage:
    band_hz = capture_band_hz(PLATE.pilot_hz, PLATE.tones.f0_hz)
    windows = ToneWindows(CHANNEL_COUNT, 10, PLATE.counter.reference_hz, band_hz)

    def ours() -> None:
        windows.restart()
        for payload in steps:
            block = windows.push(payload)
            _ = block.window(STEP - 1, min(10, block.held[STEP - 1][0])).frequency_hz

    return Stage("frequency estimation", Work("", ours, USED), numbers_of(steps))


def identification() -> Stage:
    """Four frequencies to site and force, among 16 sites; the daemon does it each 5 frames."""
    rng = np.random.default_rng(1)
    code = rng.permutation(16)[:, None] * np.ones(4)
    f0_hz = 100e6 * np.exp(-400e-6 * code + rng.uniform(-25e-6, 25e-6, (16, 4)))
    sensitivity = -6.3e-6 * rng.uniform(0.7, 1.3, (16, 1)) * np.ones(4)
    matcher, stds = Matcher(f0_hz, sensitivity, 10.0), np.full(4, 5e-10)
    measured_hz = f0_hz[5] / (1 - sensitivity[5] * 2.0)
    return Stage(
        "identification",
        Work("", lambda: matcher.match(measured_hz, stds, 1e-9, 2e-7)),
        Work("numpy, relative shift against each code", lambda: measured_hz / f0_hz - 1.0),
    )


def force_path(settling: list[bytes], steps: list[bytes]) -> Stage:
    """Take records of quartz16 to readings with contacts, five frames at once."""
    processing = SingleToneProcessing(
        force_sites(PLATE),
        pilot_hz=PLATE.pilot_hz,
        reference_hz=PLATE.counter.reference_hz,
        gate_s=1 / PLATE.counter.frame_rate_hz,
        window_frames=10,
        step_frames=STEP,
    )
    number = itertools.count(0, STEP)

    def push(payloads: list[bytes]) -> None:
        for payload in payloads:
            first = next(number)
            processing.push(first, [GATE_TICKS * (first + each) for each in range(1, STEP + 1)], payload)

    push(settling)
    return Stage("force path", Work("", lambda: push(steps), USED), numbers_of(steps))


def forces_message() -> Forces:
    head = {"seq": 1, "name": "left-index", "daemon_boot_id": "9f3c52d0", "board_boot_id": "51aa03c4", "lost": Lost()}
    when = {"t_ns": 1_789_000_000_000_000_000, "t_uncertainty_ns": 42_000, "board_ticks": 1}
    return Forces(**(EXAMPLES["Forces"] | head | when))


class Publishing:
    """A publisher whose loop runs while messages are sent."""

    def __init__(self, port: int) -> None:
        self._loop = asyncio.new_event_loop()
        self._loop.run_until_complete(self._connect(port))

    async def _connect(self, port: int) -> None:
        url = f"mqtt://127.0.0.1:{port}"
        self._publisher = Publisher(Mqtt(url=url), identifier="bench", make_will=lambda: Outgoing("bench/will", b""))
        self._running = asyncio.create_task(self._publisher.run())
        await self._until(lambda: self._publisher.connected)

    def send(self, message: Forces) -> None:
        self._loop.run_until_complete(self._send(Topic("stream", Forces), message))

    async def _send(self, topic: Topic[Forces], message: Forces) -> None:
        written = self._publisher.account.written
        for number in range(1, MESSAGES + 1):
            self._publisher.publish("bench", topic, message)
            if number % AT_ONCE == 0:
                await self._until(lambda number=number: self._publisher.account.written - written == number)

    @staticmethod
    async def _until(predicate: Callable[[], bool]) -> None:
        while not predicate():  # noqa: ASYNC110 - only to wait for the socket is measured, too
            await asyncio.sleep(0)

    def close(self) -> None:
        self._loop.run_until_complete(self._publisher.close())
        self._loop.run_until_complete(self._running)
        self._loop.close()


def publishing(stack: ExitStack, port: int) -> Stage:
    """Send messages `forces` from their model to the socket, ten at once, without acknowledgement."""
    publisher, message = Publishing(port), forces_message()
    stack.callback(publisher.close)
    payload = encode(message)
    raw = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
    raw.sendall(b"\x10\x10\x00\x04MQTT\x04\x02\x00\x00\x00\x04bare")
    raw.recv(16)
    length = 13 + len(payload)
    packet = bytes([0x30, length % 128 + 128, length // 128]) + b"\x00\x0bbare/stream" + payload
    return Stage(
        "publishing, one message",
        Work("", lambda: publisher.send(message), MESSAGES),
        Work("socket.sendall of the same bytes", lambda: [raw.sendall(packet) for _ in range(MESSAGES)], MESSAGES),
    )


def recording(folder: Path, reads: list[bytes]) -> Stage:
    """Write reads of five frames to a file of a recording, to its end."""
    path, numbers = folder / "written.mcap", itertools.count()

    def ours() -> None:
        path.unlink(missing_ok=True)
        writer = RecordingWriter(path, Origin(PLATE, "serial:/dev/ttyACM0?baud=4000000"), 0)
        for read in reads:
            writer.write(Received(HostTime(next(numbers), 0, 0), read))
        writer.finish()
        writer.close()

    def limit() -> None:
        with path.open("wb") as file:
            for read in reads:
                file.write(read)

    return Stage("recording", Work("", ours, USED), Work("file.write of the same bytes", limit, USED))


def replay(folder: Path) -> Stage:
    """Replay a recording of quartz16 with touches, from bytes to messages."""
    path = record_quartz(folder, RECORDED_S)

    def ours() -> int:
        with open_replay(path) as replaying:
            for _ in replaying.moments():
                pass
            return replaying.counters.frames

    with path.open("rb") as file:
        chunks = [part.data for part in StreamReader(file, emit_chunks=True).records if isinstance(part, Chunk)]
    frames = ours()
    limit = Work("lz4 of the chunks", lambda: [decompress(chunk) for chunk in chunks], frames)
    return Stage("replay", Work("", ours, frames), limit)


class Starts:
    """Programs that are started; `spent_s` is the processor time that they took so far."""

    def __init__(self, folder: Path) -> None:
        self.spent_s = 0.0
        self._config = folder / "start.toml"
        self._config.write_text('name = "start"\nplate = "quartz16"\nlink = "tcp://127.0.0.1:9"\n')
        self._notified = folder / "notify"

    def clock(self) -> float:
        return self.spent_s

    def daemon(self, *prefix: str) -> str:
        """Start a daemon without board and broker, until it is ready; return what it printed."""
        command = (*prefix, *COMMAND, "run", "--config", str(self._config))
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified:
            self._notified.unlink(missing_ok=True)
            notified.bind(str(self._notified))
            notified.settimeout(START_S)
            environment = os.environ | {"NOTIFY_SOCKET": str(self._notified), "PYTHONHASHSEED": "0"}
            process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
            while b"READY=1" not in notified.recv(4096):
                pass
            times = psutil.Process(process.pid).cpu_times()
            self.spent_s += times.user + times.system
            process.send_signal(signal.SIGTERM)
            return process.communicate(timeout=END_S)[1]

    def python(self) -> None:
        before = os.times()
        subprocess.run([sys.executable, "-c", BARE], check=True)
        after = os.times()
        self.spent_s += after.children_user + after.children_system - before.children_user - before.children_system


def start(folder: Path) -> Stage:
    starts = Starts(folder)
    limit = Work(f"python -c '{BARE}'", starts.python)
    return Stage("start of the daemon", Work("", starts.daemon), limit, starts.clock)


def start_instructions(folder: Path) -> float:
    """Return the instructions of a start, counted by cachegrind, which is faster than callgrind."""
    tool = ("valgrind", "--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null")
    found = re.search(r"I +refs: +([\d,]+)", Starts(folder).daemon(*tool))
    assert found is not None  # noqa: S101 - it is what cachegrind ends with
    return float(found[1].replace(",", ""))


def stages(stack: ExitStack, folder: Path) -> Iterator[Stage]:
    """Yield those whose instructions can be counted in one process: all but `start`."""
    yield framing()
    settling, steps = touched_frames()
    yield frequency_estimation(steps)
    yield identification()
    yield force_path(settling, steps)
    yield publishing(stack, stack.enter_context(broker(folder)))
    yield recording(folder, steps)
    yield replay(folder)
