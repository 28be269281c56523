"""Tare the plate of a running daemon: its present readings count as untouched.

Example: resonatord tare left-index.toml
"""

import argparse
import logging
import sys
from typing import TYPE_CHECKING

from resonator_daemon.commands._argument_types import add_config
from resonator_daemon.commands._output import print_error, print_json
from resonator_daemon.errors import ExitCode
from resonator_daemon.host.printable import printable

if TYPE_CHECKING:
    from resonator_daemon.config import Client


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "the daemon's configuration")
    parser.add_argument("--json", action="store_true", help="print the daemon's answer as one JSON object")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print what the daemon did, or why it did not."""
    import asyncio

    from resonator_daemon.config import load_client

    logging.getLogger().setLevel(logging.WARNING)  # connections are not logged here
    answer = asyncio.run(_request(load_client(arguments.config)))
    done = answer.get("ok") is True
    if arguments.json:
        print_json(answer)
    elif done:
        sys.stdout.write(f"{printable(answer.get('message', 'done'))}\n")
    if not done:
        refusal = answer.get("error")
        reasons = refusal if isinstance(refusal, dict) else {}
        parts = [str(reasons[key]) for key in ("message", "hint") if reasons.get(key)]
        print_error(f"not tared: {'; '.join(parts) or 'refused'}")
    return ExitCode.DONE if done else ExitCode.FAILED


async def _request(config: "Client") -> dict[str, object]:
    from resonator_daemon.publishing.daemon_search import find_daemon
    from resonator_daemon.publishing.requests import reach, request

    await reach(config.mqtt)
    return await request(config.mqtt, await find_daemon(config), "tare", {})
