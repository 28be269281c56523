"""Emulated boards, daemons and brokers as child processes: exactly the commands that a user would type."""

import asyncio
import json
import os
import shutil
import signal
import socket
import sys
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import psutil

from resonator_daemon.base.errors import UserError
from resonator_daemon.base.host.signals import ended_with_parent
from resonator_daemon.base.plate import Plate
from simulators.scenario_file import default_scenario

PYTHON = (sys.executable, "-m")
_RESONATORD = (*PYTHON, "resonator_daemon.commands")
_STOP_S = 5.0


class Child:
    """A running command; processor time and memory are those of the process and of all its descendants."""

    def __init__(self, part: str, process: Process, log: Path) -> None:
        self.part = part
        self._process = process
        self._log = log
        self._usage = psutil.Process(process.pid)

    def cpu_s(self) -> float:
        """Return the processor time since the start."""
        return sum(cpu_s(process) for process in self._family())

    def rss_mb(self) -> float:
        """Return the resident memory in MB."""
        return 1e-6 * sum(_rss_bytes(process) for process in self._family())

    def failure(self) -> str | None:
        """Return exit code and last line of a command that has ended by itself; None while it runs."""
        if self._process.returncode is None:
            return None
        lines = self._log.read_text().splitlines() or ["it printed nothing"]
        return f"{self.part} ended with exit code {self._process.returncode}: {lines[-1]}"

    async def first_line(self) -> bytes:
        """Wait for the first line of its output and return it.

        Raises
        ------
        UserError
            It ended without output.
        """
        line = await self._process.stdout.readline() if self._process.stdout else b""
        if not line:
            await self._process.wait()
            raise UserError(self.failure() or f"{self.part} did not start")
        return line

    async def stop(self) -> None:
        """End it by SIGINT, as Ctrl-C does; kill it after 5 s."""
        if self._process.returncode is None:
            with suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGINT)
        try:
            async with asyncio.timeout(_STOP_S):
                await self._process.wait()
        except TimeoutError:
            self._process.kill()
            await self._process.wait()

    def _family(self) -> list[psutil.Process]:
        try:
            return [self._usage, *self._usage.children(recursive=True)]
        except psutil.NoSuchProcess:
            return []


def cpu_s(process: psutil.Process) -> float:
    """Return the processor seconds of a process and of its children that have ended; 0 if it has ended itself."""
    try:
        times = process.cpu_times()
    except psutil.Error:
        return 0.0
    return float(times.user + times.system + times.children_user + times.children_system)


def busy_s() -> float:
    """Return the seconds that all processors of this computer have worked."""
    times = psutil.cpu_times()
    return float(sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0))


def _rss_bytes(process: psutil.Process) -> int:
    try:
        return int(process.memory_info().rss)
    except psutil.NoSuchProcess:
        return 0


class Emulator(NamedTuple):
    """An emulated board: its command, its link as a configuration writes it, its truth file and control socket."""

    child: Child
    link: str
    truth: Path
    control: Path


async def start_emulator(name: str, plate: Plate, folder: Path, *, by_hand: bool = False) -> Emulator:
    """Start the board of a shipped plate, pressed by its default scenario, and `by_hand` through a control socket."""
    truth, control = folder / f"{name}.truth.jsonl", folder / f"{name}.press"
    link = ("--tcp", "127.0.0.1:0") if plate.counter.frames_in_parts else ("--pty", str(folder / f"{name}.port"))
    # Without the socket a board counts far ahead, which costs less processor time.
    pressed = ("--scenario", default_scenario(plate), "--control", str(control)) if by_hand else ()
    arguments = ("emulate", "--plate", name, *link, *pressed, "--truth", str(truth), "--json")
    child, report = await _start_reporting(f"emulator {name}", folder, arguments)
    return Emulator(child, report["link"], truth, control)


async def start_live_page(broker_url: str, controls: Iterable[Path], folder: Path) -> tuple[Child, str]:
    """Start `view` on a free port, in which the plates of these control sockets can be pressed; return its address."""
    press = [argument for control in controls for argument in ("--press", str(control))]
    arguments = ("view", "--url", broker_url, "--listen", "127.0.0.1:0", *press, "--json")
    child, report = await _start_reporting("live page", folder, arguments)
    return child, report["url"]


async def _start_reporting(part: str, folder: Path, arguments: Sequence[str]) -> tuple[Child, dict[str, Any]]:
    """Start a command of resonatord; return it with the JSON object that it prints when it is ready."""
    child = await start_child(part, folder, (*_RESONATORD, *arguments), stdout=PIPE)
    async with stopped_on_error(child):
        report: dict[str, Any] = json.loads(await child.first_line())
        if "error" in report:
            raise UserError(f"{part}: {report['error']['message']}")
    return child, report


async def start_daemon(plate: str, link: str, broker_url: str, folder: Path) -> Child:
    """Start `run` on that link, publishing below `resonator/<plate>/`."""
    config = folder / f"{plate}.toml"
    config.write_text(f'name = "{plate}"\nplate = "{plate}"\nlink = "{link}"\n[mqtt]\nurl = "{broker_url}"\n')
    return await start_child(f"daemon {plate}", folder, (*_RESONATORD, "run", "--config", str(config)))


@asynccontextmanager
async def stopped_on_error(child: Child) -> AsyncIterator[None]:
    """Stop the child where the context ends with an exception, such as that of a cancelled task."""
    try:
        yield
    except BaseException:
        await child.stop()
        raise


def raise_if_ended(children: Iterable[Child]) -> None:
    """Raise UserError for a command that has ended by itself."""
    for child in children:
        if failure := child.failure():
            raise UserError(failure)


async def start_child(part: str, folder: Path, command: Sequence[str], stdout: int = DEVNULL) -> Child:
    """Start a command that ends with this process, however that ends; its stderr goes to a file in the folder."""
    log = folder / f"{part}.log"
    with log.open("w") as stderr:
        # A session of its own: Ctrl-C at the terminal reaches this process, which then ends its children in order.
        process = await asyncio.create_subprocess_exec(
            *command,
            stdin=DEVNULL,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
            preexec_fn=ended_with_parent(signal.SIGTERM),
        )
    return Child(part, process, log)


BROKER_PART: Final = "broker"
_START_S: Final = 5.0
_LOOK_S: Final = 0.05
# Where Debian installs mosquitto; a user's PATH lacks it.
MORE_PLACES = f"{os.pathsep}/usr/local/sbin{os.pathsep}/usr/sbin"


@dataclass(frozen=True, slots=True)
class LocalBroker:
    """A broker on the loopback interface; its name is `mosquitto` or `amqtt`."""

    name: str
    url: str
    child: Child


@asynccontextmanager
async def local_broker(folder: Path) -> AsyncIterator[LocalBroker]:
    """Run a broker on the loopback interface within the context; its configuration and log are in the folder.

    Raises
    ------
    UserError
        Neither Mosquitto nor amqtt is installed, or the broker does not start.
    """
    program = shutil.which("mosquitto", path=os.environ.get("PATH", "") + MORE_PLACES)
    broker = await (_start_amqtt(folder) if program is None else _start_mosquitto(program, folder))
    try:
        yield broker
    finally:
        await broker.child.stop()


async def _start_amqtt(folder: Path) -> LocalBroker:
    command = (*PYTHON, "resonator_daemon.mqtt.embedded_broker")
    child = await start_child(BROKER_PART, folder, command, stdout=PIPE)
    async with stopped_on_error(child):
        return LocalBroker("amqtt", (await child.first_line()).decode().strip(), child)


async def _start_mosquitto(program: str, folder: Path) -> LocalBroker:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    settings = folder / "mosquitto.conf"
    # Without nodelay, messages wait for the acknowledgement of those before them.
    settings.write_text(
        f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\npersistence false\nlog_type error\n"
        "user root\n"  # applies to root alone: after a change of its user, it would not end with the demo
    )
    child = await start_child(BROKER_PART, folder, (program, "-c", str(settings)))
    async with stopped_on_error(child):
        try:
            async with asyncio.timeout(_START_S):
                while (failure := child.failure()) is None:
                    try:
                        _, writer = await asyncio.open_connection("127.0.0.1", port)
                    except OSError:
                        await asyncio.sleep(_LOOK_S)
                    else:
                        writer.close()
                        return LocalBroker("mosquitto", f"mqtt://127.0.0.1:{port}", child)
        except TimeoutError:
            raise UserError(f"Mosquitto does not listen on port {port} within {_START_S:g} s") from None
    raise UserError(f"{failure}; is port {port} taken?")
