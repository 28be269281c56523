"""Find out whether wiring, sensor or software is at fault, with evidence and what to do.

Example: resonatord doctor left-index.toml
"""

import argparse
import logging
from typing import Final

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.tools.command_line import add_link, options_of, positive, separate_config

_SECONDS: Final = 10.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_link(parser, "names plate, link, broker and directories")
    parser.add_argument(
        "--seconds",
        type=positive,
        default=_SECONDS,
        metavar="N",
        help=f"duration of the capture, from the first frame (default: {_SECONDS:g})",
    )
    parser.add_argument(
        "--load",
        type=positive,
        metavar="NEWTON",
        help="also compare a known load, put on the plate of the running daemon, with what that measures",
    )
    parser.add_argument("--verbose", action="store_true", help="print each check, also of parts in which all is well")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    separate_config(arguments)
    if arguments.link is None and arguments.config is None:
        raise UsageError("name a --config FILE or a LINK (see: resonatord ports)")
    if arguments.load is not None and arguments.config is None:
        raise UsageError("--load needs a --config FILE, which names the broker of the daemon")
    from resonator_daemon.tools.doctor.run import DoctorOptions, doctor

    logging.getLogger().setLevel(logging.ERROR)  # the report has the rest
    return doctor(options_of(DoctorOptions, arguments, config_path=arguments.config, load_newton=arguments.load))
