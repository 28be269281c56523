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
        hint = "a daemon records it by: resonatord command NAME start_recording"
        raise PortInUseError(f"{error}; {hint}") from None
    return finish(arguments, result)
