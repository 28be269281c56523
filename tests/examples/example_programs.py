"""What the tests of the examples share: the C programs, built once, and programs whose lines can be waited for."""

import asyncio
import signal
import subprocess
import sys
import tempfile
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import cache
from pathlib import Path

from resonator_daemon.board.config.mqtt import Mqtt

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
DEADLINE_S = 30.0  # far beyond what any wait takes: it ends a test that hangs
WARNINGS = ("-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
LANGUAGES = ("c", "python")


@cache
def _build_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="resonator-examples-")


@cache
def c_programs() -> Path:
    """Build the C examples as their users do, but for more warnings; return the folder of the programs."""
    folder = Path(_build_folder().name)
    arguments = ("-C", folder, "-f", EXAMPLES / "c" / "Makefile", f"CFLAGS=-O2 {' '.join(WARNINGS)}")
    run("make", *arguments)
    return folder


def run(*command: object) -> None:
    """Run a command that has to succeed; what it said is in the failure."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]


def example(language: str, name: str) -> list[str]:
    """Return the command of an example."""
    if language == "c":
        return [str(c_programs() / name)]
    return [sys.executable, str(EXAMPLES / "python" / f"{name}.py")]


async def finished(name: str, broker_url: str, *arguments: str | Path) -> tuple[int | None, str, str]:
    """Run an example in Python at a broker; return its exit code and what it printed on stdout and stderr."""
    at = Mqtt(url=broker_url)
    command = [*example("python", name), at.host, str(at.port), *arguments]
    program = await asyncio.create_subprocess_exec(*command, stdout=PIPE, stderr=PIPE)
    async with asyncio.timeout(DEADLINE_S):
        printed, reported = await program.communicate()
    return program.returncode, printed.decode(), reported.decode()


@asynccontextmanager
async def running(language: str, name: str, broker_url: str, *arguments: str) -> AsyncIterator[Process]:
    """Let an example subscribe at a broker for as long as the context lasts."""
    at = Mqtt(url=broker_url)
    command = [*example(language, name), at.host, str(at.port), *arguments]
    program = await asyncio.create_subprocess_exec(*command, stdout=PIPE, stderr=DEVNULL)
    try:
        async with asyncio.timeout(DEADLINE_S):
            yield program
        if language == "python":
            program.send_signal(signal.SIGINT)
            await program.communicate()
            assert program.returncode == 0  # Ctrl-C, without a traceback
    finally:
        if program.returncode is None:
            program.kill()
        await program.communicate()


async def next_line(program: Process) -> str:
    assert program.stdout is not None
    line = (await program.stdout.readline()).decode()
    assert line.endswith("\n"), "the example ended"
    return line.rstrip("\n")
