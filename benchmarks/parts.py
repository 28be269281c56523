"""How other benchmarks start, watch and end the parts of a system, each as a process of its own."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import paho.mqtt.client as mqtt
import psutil

ROOT: Final = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests" / "support"))  # what tests and benchmarks share

NAME: Final = "hand"
COMMAND: Final = (sys.executable, "-m", "resonator_daemon.commands")
START_S: Final = 90.0
_END_S: Final = 10.0
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


@contextmanager
def broker(folder: Path) -> Iterator[int]:
    """Give the port of a Mosquitto that accepts connections."""
    port = free_port()
    with child(*mosquitto_command(port, folder)):
        until(lambda: _accepts(port), "the broker")
        yield port


def _accepts(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


def until(reached: Callable[[], bool], what: str, seconds: float = START_S) -> None:
    """Wait for something.

    Raises
    ------
    TimeoutError
        It was not reached.
    """
    deadline_s = time.monotonic() + seconds
    while not reached():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"{what}: not within {seconds:g} s")
        time.sleep(0.01)


def processor_s(pid: int) -> float:
    """Return the processor seconds of a process and its children."""
    process = psutil.Process(pid)
    times = [process.cpu_times(), *(each.cpu_times() for each in process.children(recursive=True))]
    return float(sum(each.user + each.system for each in times))


def holdings(pid: int) -> dict[str, float]:
    """Return threads, descriptors and memory of a process."""
    process = psutil.Process(pid)
    rss_mb = process.memory_info().rss / 2**20
    return {"threads": process.num_threads(), "file_descriptors": process.num_fds(), "rss_mb": rss_mb}


@contextmanager
def child(*command: str, stdout: int = subprocess.DEVNULL, **variables: str) -> Iterator["subprocess.Popen[str]"]:
    """Give a process that is interrupted at the end, with further variables of its environment."""
    environment = os.environ | variables
    process = subprocess.Popen(command, stdout=stdout, stderr=subprocess.DEVNULL, text=True, env=environment)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate()


class Emulated:
    """An emulated board; `report` is filled in when it has been stopped."""

    def __init__(self, process: "subprocess.Popen[str]", link: str) -> None:
        self.pid, self.link = process.pid, link
        self.report: dict[str, Any] = {}


@contextmanager
def emulated_board(plate: str, folder: Path, *options: str, command: tuple[str, ...] = COMMAND) -> Iterator[Emulated]:
    """Run an emulator; plates of one tone per corner are behind a pseudo-terminal, others behind TCP."""
    link = ("--pty", str(folder / "board")) if "quartz" in plate else ("--tcp", "127.0.0.1:0")
    words = (*command, "emulate", "--plate", plate, *link, *options, "--json")
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None  # noqa: S101 - it is a pipe
    emulated = Emulated(process, json.loads(process.stdout.readline())["link"])
    try:
        yield emulated
    finally:
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate()
        emulated.report.update(json.loads(rest.splitlines()[-1]))


class Subscriber:
    """Receives topics of the plate `NAME` in a thread of its own; `take` gets the path, the payload and UTC in ns."""

    def __init__(
        self, port: int, paths: tuple[str, ...], take: Callable[[str, bytes, int], None], qos: int = 1
    ) -> None:
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        base = f"resonator/{NAME}/"

        def received(_client: object, _data: object, message: mqtt.MQTTMessage) -> None:
            take(message.topic.removeprefix(base), message.payload, time.time_ns())

        self._client.on_message = received
        self._client.on_connect = lambda client, *_: client.subscribe([(base + path, qos) for path in paths])
        self._client.reconnect_delay_set(1, 1)
        self._client.connect_async("127.0.0.1", port)
        self._client.loop_start()

    def publish(self, path: str, request: dict[str, object]) -> None:
        self._client.publish(f"resonator/{NAME}/{path}", json.dumps(request))

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@dataclass
class Running:
    """A board, a broker and a daemon that publishes; `counts` has the messages by path, `last` the last of them."""

    folder: Path
    port: int
    board: Emulated
    broker_pid: int
    daemon: "subprocess.Popen[str]"
    counts: dict[str, int]
    last: dict[str, bytes]


@contextmanager
def running(
    plate: str, *options: str, command: tuple[str, ...] = COMMAND, paths: tuple[str, ...] = ("health",)
) -> Iterator[Running]:
    """Run a whole system until the first message on `forces` or `decoded`; `options` are those of the emulator."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        port = free_port()
        broker_process = stack.enter_context(child(*mosquitto_command(port, folder)))
        board = stack.enter_context(emulated_board(plate, folder, *options, command=command))
        result = "forces" if "quartz" in plate else "decoded"
        counts, last = dict[str, int](), dict[str, bytes]()

        def take(path: str, payload: bytes, _at_ns: int) -> None:
            counts[path] = counts.get(path, 0) + 1
            last[path] = payload

        config = write_config(folder, plate, board.link, port)
        daemon = stack.enter_context(child(*command, "run", "--config", str(config), OMP_NUM_THREADS="1"))
        subscriber = Subscriber(port, (result, *paths), take, qos=0)
        stack.callback(subscriber.close)
        until(lambda: result in counts, f"a message on {result}")
        yield Running(folder, port, board, broker_process.pid, daemon, counts, last)


def write_config(folder: Path, plate: str, link: str, port: int, tables: str = "") -> Path:
    """Write the configuration of a daemon of the plate `NAME`."""
    path = folder / "board.toml"
    head = f'name = "{NAME}"\nplate = "{plate}"\nlink = "{link}"\n[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
    path.write_text(head + tables)
    return path


@dataclass
class Part:
    """One process that is killed and started again; its output is appended to a log file at each start.

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
        return holdings(self.pid)

    def last_log_line(self) -> str:
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return lines[-1] if lines else "nothing"


def own_directories(folder: Path) -> dict[str, str]:
    """Return the variables of a daemon whose files are all below a folder."""
    cache, state = str(folder / "cache"), str(folder / "state")
    return {"XDG_CACHE_HOME": cache, "XDG_STATE_HOME": state, "OMP_NUM_THREADS": "1"}
