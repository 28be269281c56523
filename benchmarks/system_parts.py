"""The parts of a whole system as processes of their own, with ports that stay, to be killed and started again."""

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

BOARD, BROKER, DAEMON, DECODER = "board", "broker", "daemon", "decoder"
NAME = "hand"

_COMMAND = (sys.executable, "-m", "resonator_daemon")
_END_S = 10.0

SMALL_SKIN = """
format = 1
name = "small-skin"
outline_mm = [[-4.8, -4.8], [4.8, -4.8], [4.8, 4.8], [-4.8, 4.8]]
transducers_mm = [[-4.8, -4.8], [4.8, -4.8], [4.8, 4.8], [-4.8, 4.8]]
force_max_newton = 5
[counter]
kind = "channelised"
reference_hz = 250e6
frame_rate_hz = 50
[skin]
youngs_modulus_pascal = 2e5
poisson_ratio = 0.5
depth_mm = 1.0
[grid]
shape = [16, 16]
pitch_mm = 0.6
signals = ["p_n", "eps_xz", "eps_yz"]
f0_hz = 100e6
spacing_hz = 13000                           # of tones in the order of signal, x, y
order = [3, 48, 1]
sensitivity = [-2.0e-11, 2.7e-6, 2.7e-6]
"""


_given_ports: set[int] = set()


def free_port() -> int:
    """Return an unused TCP port that was not returned before, since its user may not listen yet."""
    while True:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port: int = probe.getsockname()[1]
        if port not in _given_ports:
            _given_ports.add(port)
            return port


def mosquitto_command(port: int, folder: Path, *settings: str) -> tuple[str, ...]:
    """Return the command line of a Mosquitto without persistence."""
    program = shutil.which("mosquitto", path=os.environ.get("PATH", "") + ":/usr/local/sbin:/usr/sbin") or "mosquitto"
    lines = (f"listener {port} 127.0.0.1", "allow_anonymous true", "set_tcp_nodelay true", "persistence false")
    path = folder / "mosquitto.conf"
    path.write_text("\n".join((*lines, *settings)) + "\n")
    return (program, "-c", str(path))


def tree_s(pid: int) -> float:
    """Return the processor seconds of a process and its children."""
    process = psutil.Process(pid)
    times = [process.cpu_times(), *(child.cpu_times() for child in process.children(recursive=True))]
    return float(sum(each.user + each.system for each in times))


@contextmanager
def child(*command: str, stdout: int = subprocess.DEVNULL) -> Iterator["subprocess.Popen[str]"]:
    """Yield a process that is interrupted at the end."""
    process = subprocess.Popen(command, stdout=stdout, stderr=subprocess.DEVNULL, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()


@dataclass
class Part:
    """One process; its output is appended to a log file at each start.

    `leftover` is a file that a killed process would leave. It is removed before the process is killed: the link to a
    dead board's terminal would otherwise lead to the next program that opens a terminal of this number.
    """

    name: str
    command: tuple[str, ...]
    log: Path
    environment: dict[str, str]
    leftover: Path | None = None
    process: "subprocess.Popen[bytes] | None" = None

    def start(self) -> None:
        self._clear_away()  # one that died by itself has left it
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                self.command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=os.environ | self.environment
            )

    @property
    def pid(self) -> int:
        if self.process is None:
            raise ValueError(f"{self.name} was never started")
        return self.process.pid

    @property
    def running(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def end(self, number: signal.Signals) -> bool:
        """Send a signal and wait for the end; return False if the process had to be killed."""
        if self.process is None:
            return True
        if number is signal.SIGKILL:
            self._clear_away()
        self.process.send_signal(number)
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._clear_away()
            self.process.kill()
            self.process.wait()
            return False
        return True

    def _clear_away(self) -> None:
        if self.leftover is not None:
            self.leftover.unlink(missing_ok=True)

    def holdings(self) -> dict[str, float]:
        """Return threads, descriptors and memory of the process."""
        process = psutil.Process(self.pid)
        return {
            "threads": process.num_threads(),
            "file_descriptors": process.num_fds(),
            "rss_mb": process.memory_info().rss / 2**20,
        }

    def last_log_line(self) -> str:
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return lines[-1] if lines else "nothing"


class System:
    """Parts by name, and how to reach their broker."""

    def __init__(self, folder: Path, plate: str, board: tuple[str, ...], link: str, *, external: bool) -> None:
        self.external = external
        self.port = free_port()
        config = folder / "board.toml"
        decoding = "[decoding]\nexternal = true\n" if external else ""
        config.write_text(
            f'name = "{NAME}"\nplate = "{plate}"\nlink = "{link}"\n[mqtt]\nurl = "mqtt://127.0.0.1:{self.port}"\n{decoding}'
        )
        commands = {
            BOARD: (*_COMMAND, "emulate", "--plate", plate, *board, "--scenario", "still"),
            BROKER: mosquitto_command(self.port, folder),
            DAEMON: (*_COMMAND, "run", "--config", str(config)),
        }
        if external:
            commands[DECODER] = (*_COMMAND, "decode", "--config", str(config))
        environment = {
            "XDG_CACHE_HOME": str(folder / "cache"),
            "XDG_STATE_HOME": str(folder / "state"),
            "OMP_NUM_THREADS": "1",
        }
        self.parts = {
            name: Part(name, command, folder / f"{name}.log", environment) for name, command in commands.items()
        }

    def start(self) -> None:
        for part in self.parts.values():
            part.start()

    def stop(self) -> None:
        for part in reversed(self.parts.values()):
            if part.running:
                part.end(signal.SIGKILL)


def skin_system(folder: Path) -> System:
    """Make the system of a small skin behind TCP, decoded in a process of its own."""
    plate, port = folder / "small.toml", free_port()
    plate.write_text(SMALL_SKIN)
    return System(folder, str(plate), ("--tcp", f"127.0.0.1:{port}"), f"tcp://127.0.0.1:{port}", external=True)


def quartz_system(folder: Path) -> System:
    """Make the system of force sites behind a pseudo-terminal."""
    port = folder / "port"
    system = System(folder, "quartz16", ("--pty", str(port)), f"serial:{port}?baud=4000000", external=False)
    system.parts[BOARD].leftover = port
    return system
