"""Print the JSON Schema of the configuration file, for editors.

Example: resonatord config schema > resonatord.schema.json
"""

import argparse
import json
import sys

from resonator_daemon.base.errors import ExitCode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="in one line")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.board.config.help import config_schema

    sys.stdout.write(json.dumps(config_schema(), indent=None if arguments.json else 2) + "\n")
    return ExitCode.DONE
