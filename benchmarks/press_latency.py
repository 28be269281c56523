"""Time from a press at the emulator's control socket to the force in a message, and what the smaller blocks cost.

Run it with `python benchmarks/press_latency.py [--plate NAME]... [--presses N]`. It starts an emulated board,
Mosquitto and a daemon for each plate, presses with 1 N at random moments, and releases. Latency is that until a
subscriber has a message with at least 0.8 N (in `forces` of quartz16, else in `contacts`), and until one without a
force above 0.1 N. Processor time of the emulator is compared with that of one without `--control`. Exit code 1 if a
plate with force sites took longer than 20 ms in the median.
"""

import argparse
import json
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from system_parts import child, free_port, mosquitto_command, tree_s

PRESSED_NEWTON, RELEASED_NEWTON, LATENCY_MAX_S = 0.8, 0.1, 0.020
PLATES = ["quartz16", "comb16"]
START_S, WAIT_S, COST_S = 60.0, 5.0, 5.0
CLI = (sys.executable, "-m", "resonator_daemon")


class Forces:
    """The largest force of the newest message of one plate, in a thread of its own."""

    def __init__(self, port: int, topic: str) -> None:
        self.broker_url = f"mqtt://127.0.0.1:{port}"
        self.newton: float | None = None
        self.changed = threading.Condition()
        self._client = mqtt.Client(CallbackAPIVersion.VERSION2)
        self._client.on_message = self._read
        self._client.connect("127.0.0.1", port)
        self._client.subscribe(f"resonator/press/{topic}")
        self._client.loop_start()

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def wait(self, low: float, high: float, timeout_s: float) -> float:
        """Wait until the force is between the two; return when it was, in seconds of the monotonic clock."""
        with self.changed:
            if not self.changed.wait_for(lambda: self.newton is not None and low <= self.newton <= high, timeout_s):
                raise TimeoutError(f"no force between {low:g} and {high:g} N within {timeout_s:g} s")
            return time.monotonic()

    def _read(self, _client: mqtt.Client, _data: object, message: mqtt.MQTTMessage) -> None:
        payload = json.loads(message.payload)
        if "sites" in payload:
            found = [site["force_newton"] for site in payload["sites"]]
        else:
            found = [contact["force_newton"][2] for contact in payload["contacts"]]
        with self.changed:
            self.newton = max((force for force in found if force is not None), default=0.0)
            self.changed.notify_all()


@contextmanager
def measured(plate: str, topic: str, *, control: bool) -> Iterator[tuple[subprocess.Popen[bytes], Path, Forces]]:
    """Run emulator, broker and daemon; give the emulator, its control socket and the forces as they are published."""
    with ExitStack() as stack:
        folder, port = Path(stack.enter_context(tempfile.TemporaryDirectory())), free_port()
        stack.enter_context(child(*mosquitto_command(port, folder)))
        scenario = folder / "ideal.toml"
        scenario.write_text("[plate]\nideal = true\n")
        pressing = ("--control", str(folder / "control")) if control else ()
        still = ("--scenario", str(scenario)) if plate in PLATES else ("--scenario", "still")
        emulate = ("emulate", "--plate", plate, "--tcp", "127.0.0.1:0", *still, *pressing, "--json")
        emulator = stack.enter_context(child(*CLI, *emulate, stdout=subprocess.PIPE))
        assert emulator.stdout is not None  # noqa: S101 - it is a pipe
        link = json.loads(emulator.stdout.readline())["link"]
        config = folder / "press.toml"
        config.write_text(
            f'name = "press"\nplate = "{plate}"\nlink = "{link}"\n[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
        )
        forces = Forces(port, topic)
        stack.callback(forces.close)
        stack.enter_context(child(*CLI, "run", "--config", str(config)))
        forces.wait(0.0, RELEASED_NEWTON, START_S)
        yield emulator, folder / "control", forces


def cores(emulator: subprocess.Popen[bytes]) -> float:
    """Return the processor time of an emulator for each second."""
    before_s, started_s = tree_s(emulator.pid), time.monotonic()
    time.sleep(COST_S)
    return (tree_s(emulator.pid) - before_s) / (time.monotonic() - started_s)


def latencies_s(control: Path, forces: Forces, presses: int) -> tuple[list[float], list[float]]:
    """Press at random moments on the middle of the plate; return the latencies of presses and of releases."""
    moments, pressed_s, released_s = random.Random(1), [], []
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(control))
        lines = client.makefile("rb")

        def ask(request: dict[str, Any]) -> float:
            sent_s = time.monotonic()
            client.sendall(json.dumps(request).encode() + b"\n")
            if not json.loads(lines.readline())["ok"]:
                raise ValueError(f"{request} was refused")
            return sent_s

        for _ in range(presses):
            time.sleep(moments.uniform(0.3, 0.4))
            sent_s = ask({"press": "a", "position_m": [-0.0005, 0.002], "force_newton": [0, 0, 1.0]})
            pressed_s.append(forces.wait(PRESSED_NEWTON, 2.0, WAIT_S) - sent_s)
            time.sleep(moments.uniform(0.3, 0.4))
            sent_s = ask({"release": "a"})
            released_s.append(forces.wait(-1.0, RELEASED_NEWTON, WAIT_S) - sent_s)
    return pressed_s, released_s


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plate", action="append", help="default: quartz16 and comb16")
    parser.add_argument("--presses", type=int, default=30, help="default: %(default)s")
    options = parser.parse_args()
    late = False
    print(f"{'':14}{'press, ms':>24}{'release, ms':>24}{'emulator, cores':>24}")
    print(f"{'':14}{'median':>12}{'largest':>12}{'median':>12}{'largest':>12}{'control':>12}{'without':>12}")
    for plate in options.plate or PLATES:
        topic = "forces" if plate == "quartz16" else "contacts"  # those of comb16 are of sites, not of touches
        with measured(plate, topic, control=True) as (emulator, control, forces):
            used = cores(emulator)
            found = latencies_s(control, forces, options.presses)
        with measured(plate, topic, control=False) as (emulator, _, _):
            without = cores(emulator)
        figures = [1e3 * figure for each in found for figure in (statistics.median(each), max(each))]
        print(f"{plate:14}" + "".join(f"{each:12.1f}" for each in figures) + f"{used:12.3f}{without:12.3f}")
        late |= plate in PLATES and statistics.median(found[0]) > LATENCY_MAX_S
    return int(late)


if __name__ == "__main__":
    sys.exit(main())
