"""The stages that `stage_cost.py` measures: whole processes at work, a replay, and frames under a skin."""

import json
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TypedDict

import numpy as np
import psutil
from paho.mqtt import subscribe
from system_parts import free_port, mosquitto_command

SLICES, SLICE_S = 4, 3.0
RECORDED_S = 10.0
DEMO_S = 15.0
RATES_HZ = {"quartz16": 1000, "skin32": 100}
_LOOP_ROUNDS = 400


class Cost(TypedDict):
    """Processor time of a frame in microseconds, and as a multiple of the reference loop's."""

    us: float
    ratio: float


Stages = dict[str, Cost]
Part = Callable[[Path, Path], Stages]


def reference_us() -> float:
    """Return the processor time of one pass of a fixed loop of Python and numpy, in microseconds."""
    values = np.linspace(0.0, 1.0, 256)
    counts: dict[int, int] = {}
    started_ns = time.thread_time_ns()
    for number in range(_LOOP_ROUNDS):
        values = values * 0.5 + 0.25
        for key in range(40):
            counts[key] = counts.get(key, 0) + number
        text = ",".join([str(key) for key in counts])
        values[number % 256] = len(text.split(",")) * float(values.sum()) * 1e-6
    return (time.thread_time_ns() - started_ns) / _LOOP_ROUNDS * 1e-3


def median_cost(samples: list[tuple[float, float]]) -> Cost:
    """Return the medians of pairs of a stage's and the loop's microseconds."""
    us = statistics.median(us for us, _ in samples)
    return Cost(us=round(us, 1), ratio=round(statistics.median(us / loop for us, loop in samples), 3))


def tree_s(pid: int) -> float:
    """Return the processor seconds of a process and its children."""
    process = psutil.Process(pid)
    times = [process.cpu_times(), *(child.cpu_times() for child in process.children(recursive=True))]
    return float(sum(each.user + each.system for each in times))


@contextmanager
def child(*command: str, stdout: int = subprocess.DEVNULL) -> Iterator["subprocess.Popen[str]"]:
    """Give a process that is interrupted at the end."""
    process = subprocess.Popen(command, stdout=stdout, stderr=subprocess.DEVNULL, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()


def live(plate: str, decoding: str, topic: str, names: dict[str, str], python: Path, folder: Path) -> Stages:
    """Measure a daemon and its emulator at real time, from the first message on `topic`."""
    cli = (str(python.with_name("resonatord")),)  # also of another version, whose modules have other names
    link = ("--pty", str(folder / "board")) if plate == "quartz16" else ("--tcp", "127.0.0.1:0")
    config, port = folder / "board.toml", free_port()
    with ExitStack() as stack:
        start = lambda *command, **options: stack.enter_context(child(*command, **options))  # noqa: E731
        start(*mosquitto_command(port, folder))
        emulator = start(*cli, "emulate", "--plate", plate, *link, "--json", stdout=subprocess.PIPE)
        assert emulator.stdout is not None  # noqa: S101 - it is a pipe
        address = json.loads(emulator.stdout.readline())["link"]
        config.write_text(
            f'name = "cost"\nplate = "{plate}"\nlink = "{address}"\n[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
            f'[decoding]\nmethod = "{decoding}"\n'
        )
        processes = {"daemon": start(*cli, "run", "--config", str(config)), "emulator": emulator}
        subscribe.simple(f"resonator/cost/{topic}", port=port)
        samples: dict[str, list[tuple[float, float]]] = {role: [] for role in names}
        for _ in range(SLICES):
            before = {role: tree_s(processes[role].pid) for role in names}
            started_s, loops_us = time.monotonic(), []
            while (passed_s := time.monotonic() - started_s) < SLICE_S:
                time.sleep(0.1)
                loops_us.append(reference_us())
            for role in names:
                frame_us = (tree_s(processes[role].pid) - before[role]) / (passed_s * RATES_HZ[plate]) * 1e6
                samples[role].append((frame_us, min(loops_us)))  # the processes measured disturb the loop, too
    return {name: median_cost(samples[role]) for role, name in names.items()}


def demo(python: Path, _folder: Path) -> Stages:
    """Measure the demo's own process with its broker, and all its processes, per frame of quartz16."""
    command = (
        str(python.with_name("resonatord")),
        "demo",
        "--headless",
        "--seconds",
        str(DEMO_S),
        "--json",
    )
    loop_us = reference_us()
    run = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=python.parents[2]
    )  # for its children
    loop_us = min(loop_us, reference_us())
    if not run.stdout:
        sys.exit(f"demo: exit code {run.returncode}: {run.stderr.strip()}")
    result = json.loads(run.stdout)
    own = sum(value for part, value in result["cpu_percent_by_part"].items() if not part.startswith(("d", "e")))
    us = {"demo process and broker": own * 1e4 / RATES_HZ["quartz16"], "demo, all": result["cores"] * 1e3}
    return {name: median_cost([(value, loop_us)]) for name, value in us.items()}


def worker(script: str, python: Path, folder: Path) -> Stages:
    """Run a script of this directory with the checkout's Python; it prints the pairs of each stage as JSON."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "XDG_CACHE_HOME": str(folder)}
    command = (str(python), str(Path(__file__).with_name(script)), str(folder))
    run = subprocess.run(command, stdout=subprocess.PIPE, env=environment, text=True, check=True)
    return {name: median_cost(samples) for name, samples in json.loads(run.stdout).items()}


PARTS: dict[str, Part] = {
    "quartz16 at real time": partial(
        live, "quartz16", "off", "forces", {"daemon": "quartz16, daemon", "emulator": "quartz16, emulator"}
    ),
    "skin32 at real time, not decoded": partial(
        live, "skin32", "off", "signals", {"daemon": "skin32, daemon without decoding", "emulator": "skin32, emulator"}
    ),
    "skin32 at real time, decoded": partial(
        live, "skin32", "open-plane", "decoded", {"daemon": "skin32, daemon with decoding"}
    ),
    "demo": demo,
    "replay of quartz16": partial(worker, "stage_cost_replay.py"),
    "decoding of skin32": partial(worker, "stage_cost_decoding.py"),
}
