"""Whole processes at real time, for `stages.py`: processor time of daemons by frame rate and by number of plates."""

import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from stages_system import broker
from system_parts import child, tree_s

SHIPPED = Path(__file__).resolve().parents[1] / "resonator_daemon/plates" / "quartz16.toml"
CLI = (sys.executable, "-m", "resonator_daemon")
RATES_HZ = (200, 400, 1000, 2000)  # steps of 5 ms are whole frames
PLATE_COUNTS = (1, 2, 4, 8)
SHARED_HZ = 200  # frame rate of plates of which there are many
START_S = 60.0
SETTLE_S, SLICE_S, SLICES = 2.0, 2.0, 3


class Live(NamedTuple):
    """Processor time of a frame in µs; a daemon includes the process of its decoder."""

    daemon_us: float
    emulator_us: float


def measure(rate_hz: int, plates: int) -> Live:
    """Run daemons with an emulated board each, one broker for all; return what a frame of one plate costs."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        port = stack.enter_context(broker(folder))
        file = folder / "quartz16.toml"
        shipped = SHIPPED.read_text()
        file.write_text(re.sub("(?m)^frame_rate_hz = .*", f"frame_rate_hz = {rate_hz}", shipped))
        emulators, daemons = [], []
        for number in range(plates):
            command = (*CLI, "emulate", "--plate", str(file), "--pty", str(folder / f"board{number}"), "--json")
            emulator = stack.enter_context(child(*command, stdout=subprocess.PIPE))
            assert emulator.stdout is not None  # noqa: S101 - it is a pipe
            address = json.loads(emulator.stdout.readline())["link"]
            config = folder / f"plate{number}.toml"
            config.write_text(
                f'name = "plate{number}"\nplate = "{file}"\nlink = "{address}"\n'
                f'[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
            )
            emulators.append(emulator)
            daemons.append(stack.enter_context(child(*CLI, "run", "--config", str(config))))
        for number, daemon in enumerate(daemons):
            await_message(f"resonator/plate{number}/forces", port, daemon)
        time.sleep(SETTLE_S)
        slices = []
        for _ in range(SLICES):
            before_s, started_s = [total_s(group) for group in (daemons, emulators)], time.monotonic()
            time.sleep(SLICE_S)
            spent_s = [total_s(group) for group in (daemons, emulators)]
            frames = (time.monotonic() - started_s) * rate_hz * plates
            slices.append([(after - before) / frames * 1e6 for after, before in zip(spent_s, before_s, strict=True)])
        return Live(*(statistics.median(each) for each in zip(*slices, strict=True)))


def await_message(topic: str, port: int, daemon: "subprocess.Popen[str]") -> None:
    """Wait for the first message of a daemon."""
    received: list[object] = []
    client = mqtt.Client(CallbackAPIVersion.VERSION2)
    client.on_message = lambda _client, _data, message: received.append(message)
    client.connect("127.0.0.1", port)
    client.subscribe(topic)
    until_s = time.monotonic() + START_S
    while not received:
        client.loop(0.1)
        if daemon.poll() is not None or time.monotonic() > until_s:
            sys.exit(f"no message on {topic} within {START_S:g} s; exit code of the daemon: {daemon.poll()}")
    client.disconnect()


def total_s(processes: list["subprocess.Popen[str]"]) -> float:
    return sum(tree_s(process.pid) for process in processes)


def by_rate() -> dict[int, Live]:
    return {rate_hz: measure(rate_hz, 1) for rate_hz in RATES_HZ}


def by_plates() -> dict[int, Live]:
    return {plates: measure(SHARED_HZ, plates) for plates in PLATE_COUNTS}
