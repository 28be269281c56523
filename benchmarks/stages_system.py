"""Stages around the measurement, for `stages.py`: publishing, recording, replay, start of the daemon."""

import asyncio
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import paho.mqtt.client as mqtt
import psutil
from lz4.frame import decompress
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from paho.mqtt.enums import CallbackAPIVersion
from replay_speed import record
from stage_measure import Growth, Stage, Work
from stages_force import STEP, QuartzFrames
from system_parts import free_port, mosquitto_command

from resonator_daemon.config import Mqtt
from resonator_daemon.plate import load_plate
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.mqtt_messages import Outgoing
from resonator_daemon.publishing.payloads import Compensation, Decoded, Forces, Lost, Message, SiteForce
from resonator_daemon.publishing.publisher import Publisher
from resonator_daemon.publishing.topics import Topic
from resonator_daemon.recording.mcap_messages import CHUNK_BYTES
from resonator_daemon.recording.reader import Origin
from resonator_daemon.recording.writer import RecordingWriter
from resonator_daemon.replay.source import open_replay
from resonator_daemon.session.host_time import HostTime
from resonator_daemon.session.link_events import Received

MESSAGES, AT_ONCE = 200, 10
RECORDED_S = 3.0
START_S, END_S = 120.0, 30.0
BARE = "import numpy, pydantic, paho.mqtt.client"
_HEADER: dict[str, Any] = {
    "seq": 1,
    "name": "left-index",
    "daemon_boot_id": "9f3c52d0",
    "board_boot_id": "51aa03c4",
    "t_ns": 1_789_000_000_000_000_000,
    "t_uncertainty_ns": 42_000,
    "lost": Lost(),
    "board_ticks": 1,
}


def forces(sites: int) -> Forces:
    site = SiteForce(site=7, force_newton=1.234, noise_newton=0.0006, systematic_newton=0.012, status="ok")
    compensation = Compensation(
        baseline="followed",
        common_mode=(3e-6,) * 4,
        common_mode_std=2e-7,
        plate_kelvin=0.5,
        plate_kelvin_std=0.1,
        response="off",
    )
    left = {"window_s": 0.01, "status": "ok", "reason": "", "beats": (), "compensation": compensation}
    return Forces(**_HEADER, **left, sites=(site,) * sites)


def decoded(side: int) -> Decoded:
    maps = np.zeros((3, side, side), np.float32)
    return Decoded(**_HEADER, traction_pascal=maps, traction_std_pascal=maps, displacement_m=maps, grid=None)


@contextmanager
def broker(folder: Path) -> Iterator[int]:
    """Give the port of a Mosquitto that accepts connections."""
    port = free_port()
    process = subprocess.Popen(mosquitto_command(port, folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while True:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
                break
            except ConnectionRefusedError:
                time.sleep(0.01)
        yield port
    finally:
        process.kill()
        process.wait()


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

    def work(self, message: Message, messages: int = MESSAGES) -> Work:
        topic: Topic[Message] = Topic("stream", type(message))
        return Work("", lambda: self._loop.run_until_complete(self._send(topic, message, messages)), messages)

    async def _send(self, topic: Topic[Message], message: Message, messages: int) -> None:
        written = self._publisher.account.written
        for number in range(1, messages + 1):
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
    """Compare a message `forces` from its model to the socket, ten at once, without acknowledgement."""
    ours = Publishing(port)
    stack.callback(ours.close)
    message = forces(1)
    values = json.loads(encode(message))
    client = mqtt.Client(CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
    client.connect("127.0.0.1", port)
    client.loop_start()
    stack.callback(client.loop_stop)
    payload = encode(message)
    raw = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
    raw.sendall(b"\x10\x10\x00\x04MQTT\x04\x02\x00\x00\x00\x04bare")
    raw.recv(16)
    length = 13 + len(payload)
    packet = bytes([0x30, length % 128 + 128, length // 128]) + b"\x00\x0bbare/stream" + payload

    def peer() -> None:
        for _ in range(MESSAGES):
            sent = client.publish("bare/stream", json.dumps(values))
        sent.wait_for_publish()

    def limit() -> None:
        for _ in range(MESSAGES):
            raw.sendall(packet)

    return Stage(
        "publishing, one message",
        ours.work(message),
        Work("paho publish of json.dumps of a dictionary", peer, MESSAGES),
        Work("socket.sendall of the same bytes", limit, MESSAGES),
    )


def recording(folder: Path, frames: QuartzFrames) -> Stage:
    """Compare reads of five frames to a file of a recording, to its end."""
    plate, link = frames.plate, "serial:/dev/ttyACM0?baud=4000000"
    reads, numbers = frames.steps, itertools.count()
    path = folder / "written.mcap"
    count = len(reads) * STEP

    def ours() -> None:
        path.unlink(missing_ok=True)
        writer = RecordingWriter(path, Origin(plate, link), 0)
        for read in reads:
            writer.write(Received(HostTime(next(numbers), 0, 0), read))
        writer.finish()
        writer.abandon()

    def peer() -> None:
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
            writer.start()
            channel = writer.register_channel("wire", "raw", schema_id=0)
            for number, read in enumerate(reads):
                writer.add_message(channel, number, read, number)
            writer.finish()

    def limit() -> None:
        with path.open("wb") as file:
            for read in reads:
                file.write(read)

    return Stage(
        "recording",
        Work("", ours, count),
        Work("mcap Writer of the same bytes, with lz4", peer, count),
        Work("file.write of the same bytes", limit, count),
    )


def replay(folder: Path) -> Stage:
    """Compare a recording of quartz16 with touches, from bytes to messages."""
    path = record(folder, RECORDED_S)

    def ours() -> int:
        with open_replay(path) as replaying:
            for _ in replaying.moments():
                pass
            return replaying.counters.frames

    def peer() -> None:
        with path.open("rb") as file:
            for _ in make_reader(file).iter_messages():
                pass

    with path.open("rb") as file:
        chunks = [part.data for part in StreamReader(file, emit_chunks=True).records if isinstance(part, Chunk)]
    frames = ours()
    return Stage(
        "replay",
        Work("", ours, frames),
        Work("mcap reader, events without their meaning", peer, frames),
        Work("lz4 of the chunks", lambda: [decompress(chunk) for chunk in chunks], frames),
    )


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
        """Start a daemon without board and broker, until it is ready; return the last lines of `prefix`, if any."""
        command = (*prefix, sys.executable, "-m", "resonator_daemon", "run", "--config", str(self._config))
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

    def python(self, program: str) -> None:
        before = os.times()
        subprocess.run([sys.executable, "-c", program], check=True)
        after = os.times()
        self.spent_s += after.children_user + after.children_system - before.children_user - before.children_system


def start(starts: Starts) -> Stage:
    return Stage(
        "start of the daemon",
        Work("", starts.daemon),
        Work(f"python -c '{BARE}'", lambda: starts.python(BARE)),
        Work("python -c pass", lambda: starts.python("pass")),
        starts.clock,
    )


def start_instructions(folder: Path) -> float:
    """Return the instructions of a start, counted by cachegrind, which is faster than callgrind."""
    tool = ("valgrind", "--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null")
    found = re.search(r"I +refs: +([\d,]+)", Starts(folder).daemon(*tool))
    assert found is not None  # noqa: S101 - it is what cachegrind ends with
    return float(found[1].replace(",", ""))


def stages(stack: ExitStack, folder: Path) -> Iterator[Stage]:
    """Yield those whose instructions can be counted in one process: all but `start`."""
    port = stack.enter_context(broker(folder))
    yield publishing(stack, port)
    yield recording(folder, QuartzFrames())
    yield replay(folder)


def growths(stack: ExitStack, folder: Path) -> Iterator[Growth]:
    ours = Publishing(stack.enter_context(broker(folder)))
    stack.callback(ours.close)
    yield Growth("publishing of `forces`", "sites", (16, 64, 256, 1024), lambda sites: ours.work(forces(sites), 20))
    yield Growth("publishing of `decoded`", "grid", (16, 32, 64, 128), lambda side: ours.work(decoded(side), 20))
    yield Growth("recording", "sites", (16, 64, 256, 1024), lambda tones: recorded_frames(folder, tones))


def recorded_frames(folder: Path, tones: int) -> Work:
    """Record channelised frames, whose size grows with the number of tones."""
    data = os.urandom(4 * 8 * tones)
    path, plate = folder / "frames.mcap", load_plate("comb16")
    numbers = itertools.count()

    def run() -> None:
        path.unlink(missing_ok=True)
        writer = RecordingWriter(path, Origin(plate, "tcp://127.0.0.1:9"), 0)
        for _ in range(MESSAGES):
            writer.write(Received(HostTime(next(numbers), 0, 0), data))
        writer.finish()
        writer.abandon()

    return Work("", run, MESSAGES)
