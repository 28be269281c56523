"""Print the AsyncAPI document of all topics, payloads and commands.

Example: resonatord schema > resonatord.asyncapi.json
"""

import argparse
import json
import sys

from resonator_daemon.base.errors import ExitCode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="in one line")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.mqtt.asyncapi import document

    sys.stdout.write(json.dumps(document(), indent=None if arguments.json else 2, ensure_ascii=False) + "\n")
    return ExitCode.DONE
