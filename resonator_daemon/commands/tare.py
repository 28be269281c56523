"""Tare the plate of a running daemon: its present readings count as untouched.

Right after a start the daemon has no readings yet: a window of untouched ones has to be complete. The command waits
for it, and for a plate that is touched, as long as --wait allows.

Example: resonatord tare left-index
"""

import argparse
import logging
from collections.abc import Mapping

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.base.host.text import print_note
from resonator_daemon.tools.command_line import add_broker, add_daemon, client_of, number, print_answer, send_command


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_daemon(parser, required=False)
    add_broker(parser)
    parser.add_argument(
        "--wait", type=number(0, 3600), default=5.0, metavar="S", help="for an untouched reading (default: 5 s)"
    )
    parser.add_argument("--json", action="store_true", help="print the daemon's answer as one JSON object")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print what the daemon did, or why it did not."""
    import asyncio

    def waiting(refusal: Mapping[str, object]) -> None:
        print_note(f"{refusal.get('message')}; waiting up to {arguments.wait:g} s for an untouched reading")

    logging.getLogger().setLevel(logging.WARNING)  # connections are not logged here
    client = client_of(arguments)
    answer = asyncio.run(send_command(client, "tare", {}, wait_s=arguments.wait, on_wait=waiting))
    return print_answer(answer, "not tared", as_json=arguments.json, only="message")
