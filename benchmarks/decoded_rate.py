"""Share of the frames of skin32 that are decoded at 250 frames/s, and the processor time that it takes.

Run it with `python benchmarks/decoded_rate.py [--rate HZ] [--seconds N]`. It starts an emulated board, Mosquitto and a
daemon with its decoder, counts the messages on `decoded`, and prints the cores of each process. Exit code 1 if less
than 98 % of the frames were decoded, or if the daemon with its decoder used more than 0.8 core.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import paho.mqtt.client as mqtt
import psutil
from paho.mqtt.enums import CallbackAPIVersion
from system_parts import child, free_port, mosquitto_command, tree_s

from resonator_daemon.demo.processes import ProcessorTimes

DECODED_MIN, CORES_MAX = 0.98, 0.8
ROOT = Path(__file__).resolve().parents[1]
START_S, SETTLE_S = 60.0, 3.0


class Subscriber:
    """Counts messages on `decoded` and keeps the last `health`, in a thread of its own."""

    def __init__(self, port: int) -> None:
        self.decoded = 0
        self.health: dict[str, int] = {}
        self._client = mqtt.Client(CallbackAPIVersion.VERSION2)
        self._client.on_message = self._count
        self._client.connect("127.0.0.1", port)
        for topic in ("decoded", "health"):
            self._client.subscribe(f"resonator/rate/{topic}")
        self._client.loop_start()

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def _count(self, _client: mqtt.Client, _data: object, message: mqtt.MQTTMessage) -> None:
        if message.topic.endswith("decoded"):
            self.decoded += 1
        else:
            self.health = json.loads(message.payload)


def process_ids(pid: int) -> set[int]:
    """Return the ids of a process and its children."""
    process = psutil.Process(pid)
    return {process.pid, *(each.pid for each in process.children(recursive=True))}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=250.0, help="frames per second (default: %(default)g)")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the measurement (default: %(default)g)")
    options = parser.parse_args()
    cli = (sys.executable, "-m", "resonator_daemon")
    with ExitStack() as stack:
        folder, port = Path(stack.enter_context(tempfile.TemporaryDirectory())), free_port()
        broker = stack.enter_context(child(*mosquitto_command(port, folder)))
        plate, config = folder / "skin32.toml", folder / "rate.toml"
        shipped = (ROOT / "resonator_daemon/plates" / "skin32.toml").read_text()
        plate.write_text(re.sub("(?m)^frame_rate_hz = .*", f"frame_rate_hz = {options.rate:g}", shipped))
        emulate = ("emulate", "--plate", "skin32", "--tcp", "127.0.0.1:0", "--frame-rate-hz", f"{options.rate:g}")
        emulator = stack.enter_context(child(*cli, *emulate, "--json", stdout=subprocess.PIPE))
        assert emulator.stdout is not None  # noqa: S101 - it is a pipe
        link = json.loads(emulator.stdout.readline())["link"]
        config.write_text(
            f'name = "rate"\nplate = "{plate}"\nlink = "{link}"\n[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
        )
        subscriber = Subscriber(port)
        stack.callback(subscriber.close)
        daemon = stack.enter_context(child(*cli, "run", "--config", str(config)))
        processes = {"daemon and decoder": daemon, "emulator": emulator, "broker": broker}
        deadline_s = time.monotonic() + START_S
        while not subscriber.decoded:
            if time.monotonic() > deadline_s:
                sys.exit(f"no frame was decoded within {START_S:g} s")
            time.sleep(0.1)
        time.sleep(SETTLE_S)
        load = ProcessorTimes()
        decoded, started_s = subscriber.decoded, time.monotonic()
        before_s = {name: tree_s(process.pid) for name, process in processes.items()}
        time.sleep(options.seconds)
        passed_s = time.monotonic() - started_s
        share = (subscriber.decoded - decoded) / (passed_s * options.rate)
        load.stop()
        cores = {name: (tree_s(process.pid) - before_s[name]) / passed_s for name, process in processes.items()}
        own = {process for each in processes.values() for process in process_ids(each.pid)} | {os.getpid()}
    print(f"decoded: {100 * share:.1f} % of {options.rate:g} frames/s for {passed_s:.0f} s")
    for name, used in cores.items():
        print(f"{name:20}{used:6.2f} cores")
    print(f"lost, skipped: {subscriber.health.get('lost')}, {subscriber.health.get('decoder')}")
    print(load.in_words(sum(cores.values()) * passed_s, own))
    return int(share < DECODED_MIN or cores["daemon and decoder"] > CORES_MAX)


if __name__ == "__main__":
    sys.exit(main())
