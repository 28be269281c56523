"""What commands print: JSON and pages to the standard output, errors and notes to the standard error."""

import io
import json
import sys
from typing import Any

from resonator_daemon.base.errors import UserError
from resonator_daemon.base.host.systemd import error_prefix
from resonator_daemon.base.host.text import coloured, printable


def print_json(value: object) -> None:
    """Print a value as one line of JSON."""
    sys.stdout.write(json.dumps(value) + "\n")


def print_failure(command: str, error: UserError) -> None:
    """Print the JSON object of a command that failed: what there is of its result, and why."""
    why = {"code": error.code, "message": str(error), "hint": error.hint}  # a daemon's refusal has its own
    print_json({"verb": command, "ok": False, "error": why} | {**error.so_far, "ok": False})


def print_page(page: Any) -> None:
    """Print a renderable of rich; characters that the terminal's encoding lacks become question marks."""
    from rich.console import Console

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    Console(highlight=False).print(page)


def print_error(*messages: str) -> None:
    """Print each message as one line to the standard error."""
    for message in messages:
        program = coloured("resonatord:", "red", sys.stderr)
        sys.stderr.write(f"{error_prefix()}{program} {printable(message)}\n")
