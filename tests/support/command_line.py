"""The command line, in the test's own process and in one of its own."""

import subprocess
import sys
from typing import Any

from resonator_daemon.commands import main

PROGRAM = (sys.executable, "-m", "resonator_daemon.commands")


def run_command(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command in its own process and return its result."""
    command = [*PROGRAM, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, **options)


def exit_code(*words: object) -> int:
    """Run a command; return its exit code, also where the parser exits."""
    try:
        return main([str(word) for word in words])
    except SystemExit as ended:
        return int(ended.code or 0)
