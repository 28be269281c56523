"""Print a configuration to start from.

Example: resonatord config example > left-index.toml
"""

import argparse
import sys

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.tools.command_line.output import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print it as a JSON string")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.base.host.text import with_pages
    from resonator_daemon.board.config import example_config

    text = with_pages(example_config())
    if arguments.json:
        print_json({"verb": "config example", "example": text})
    else:
        sys.stdout.write(text)
    return ExitCode.DONE
