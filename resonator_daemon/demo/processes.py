"""Emulated boards and daemons as child processes: exactly the commands that a user would type."""

import asyncio
import json
import signal
import sys
from asyncio.subprocess import DEVNULL, PIPE, Process
from pathlib import Path

import psutil

from resonator_daemon.errors import OperatorError

_COMMAND = (sys.executable, "-m", "resonator_daemon.cli")
_STOP_S = 5.0


class Child:
    """A running command of ours, what it costs, and its orderly end."""

    def __init__(self, part: str, process: Process, log: Path) -> None:
        self.part = part
        self._process = process
        self._log = log
        self._usage = psutil.Process(process.pid)
        self._cpu_mark_s = 0.0

    def mark(self) -> None:
        """Count processor time from here."""
        self._cpu_mark_s = self._cpu_s()

    def cpu_s(self) -> float:
        """Processor time since the mark."""
        return self._cpu_s() - self._cpu_mark_s

    def rss_mb(self) -> float:
        return float(self._usage.memory_info().rss) * 1e-6

    def complaint(self) -> str | None:
        """Return the last words of a child that ended by itself; None while it runs."""
        if self._process.returncode is None:
            return None
        lines = self._log.read_text().splitlines() or ["it said nothing"]
        return f"{self.part} ended with exit code {self._process.returncode}: {lines[-1]}"

    async def stop(self) -> None:
        """End it as Ctrl-C would; kill it when that takes too long."""
        if self._process.returncode is None:
            self._process.send_signal(signal.SIGINT)
        try:
            async with asyncio.timeout(_STOP_S):
                await self._process.wait()
        except TimeoutError:
            self._process.kill()
            await self._process.wait()

    def _cpu_s(self) -> float:
        times = self._usage.cpu_times()
        return float(times.user + times.system)


async def start_emulator(plate: str, folder: Path, kind: str) -> tuple[Child, str, Path]:
    """Start an emulated board; return it, its link as a configuration writes it, and its truth file."""
    truth = folder / f"{plate}.truth.jsonl"
    link = ("--pty", str(folder / f"{plate}.port")) if kind == "single-tone" else ("--tcp", "127.0.0.1:0")
    arguments = ("emulate", "--plate", plate, *link, "--truth", str(truth), "--json")
    child, process = await _start(f"emulator {plate}", folder, arguments, stdout=PIPE)
    line = await process.stdout.readline() if process.stdout else b""
    if not line:
        await process.wait()
        raise OperatorError(child.complaint() or f"emulator {plate} did not start")
    return child, json.loads(line)["link"], truth


async def start_daemon(plate: str, link: str, broker_url: str, folder: Path) -> Child:
    """Start a daemon on that link, publishing below `resonator/<plate>/`."""
    config = folder / f"{plate}.toml"
    config.write_text(f'name = "{plate}"\nplate = "{plate}"\nlink = "{link}"\n[mqtt]\nurl = "{broker_url}"\n')
    child, _ = await _start(f"daemon {plate}", folder, ("run", "--config", str(config)))
    return child


async def _start(part: str, folder: Path, arguments: tuple[str, ...], stdout: int = DEVNULL) -> tuple[Child, Process]:
    log = folder / f"{part}.log"
    with log.open("w") as stderr:
        # A session of its own: Ctrl-C at the terminal reaches the demo, which then ends its children in order.
        process = await asyncio.create_subprocess_exec(
            *_COMMAND, *arguments, stdin=DEVNULL, stdout=stdout, stderr=stderr, start_new_session=True
        )
    return Child(part, process, log), process
