"""An emulated board in a child process, for benchmarks that count this process's own time."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def emulated_board(plate: str, folder: Path, *options: str) -> Iterator[tuple[str, "dict[str, Any]"]]:
    """Give the link text and a report that is filled in when the board has been stopped."""
    link = ("--pty", str(folder / "board")) if plate == "quartz16" else ("--tcp", "127.0.0.1:0")
    command = [sys.executable, "-m", "resonator_daemon", "emulate", "--plate", plate, *link, *options, "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    report: dict[str, Any] = {}
    try:
        assert process.stdout is not None  # noqa: S101 - it is a pipe
        yield json.loads(process.stdout.readline())["link"], report
    finally:
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate()
        report.update(json.loads(rest.splitlines()[-1]))
