"""Record a board's link to a file that `link = "replay:FILE"` replays.

Example: resonatord record left-index.toml --output run.mcap --seconds 60
"""

import argparse
from pathlib import Path

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.tools.command_line import add_config, finish, options_of, positive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "the configuration: names the plate and the link")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE", help="the file to make, as run.mcap")
    parser.add_argument(
        "--seconds", type=positive, metavar="N", help="from the first frame on (default: until interrupted)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.daemon.service.link_recording import PortInUseError, RecordOptions, record

    try:
        result = record(arguments.config, options_of(RecordOptions, arguments))
    except PortInUseError as error:
        raise PortInUseError(f"{error}{_of_the_daemon(arguments.config)}") from None
    return finish(arguments, result)


def _of_the_daemon(config_path: Path) -> str:
    """Return how the daemon that has the link records it itself; empty where none is found."""
    import asyncio

    from resonator_daemon.board.config import load_config
    from resonator_daemon.tools.doctor.daemon_checks import find_daemon

    answer = asyncio.run(find_daemon(load_config(config_path).link, config_path, ()))
    if answer is None or answer.status is None:
        return ""
    name = answer.status.get("name") or "NAME"
    command = f"resonatord command {name} start_recording --config {config_path}"
    return f"; the daemon {name} reads it and can record it: {command}"
