"""Print what a key of the configuration is, its type, default, range and an example.

Example: resonatord config explain mqtt.url
"""

import argparse
import shutil
import sys

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.tools.command_line.output import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "key", nargs="?", default="", metavar="KEY", help="as mqtt.url, or mqtt for all of that table (default: a list)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.board.config.help import UnknownKeyError, explained, explanation, key_list

    try:
        keys = explained(arguments.key)
    except UnknownKeyError as error:
        raise UsageError(str(error)) from None
    if arguments.json:
        print_json({"verb": "config explain", "keys": [key._asdict() for key in keys]})
        return ExitCode.DONE
    columns = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    text = "\n".join(explanation(key, columns) for key in keys) if arguments.key else key_list(keys, columns)
    sys.stdout.write(text)
    return ExitCode.DONE
