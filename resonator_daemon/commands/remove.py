"""Remove a plate that is gone for good from discovery: clear its retained topics.

Its daemon must be offline. A plate that comes back publishes its topics again.

Example: resonatord remove left-index --url mqtt://127.0.0.1:1883
"""

import argparse
import sys

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.base.host.text import printable
from resonator_daemon.tools.command_line import add_broker, add_daemon, client_of, finish


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_daemon(parser)
    add_broker(parser)
    parser.add_argument(
        "--force",
        action="store_true",
        help="also where the daemon's last state is not offline, as when broker and computer went away together",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print which topics were cleared."""
    import asyncio

    from resonator_daemon.mqtt.removal import remove_plate

    client = client_of(arguments)
    if (name := client.name) is None:
        raise UsageError(f"{arguments.name} has no name, as the board's serial number is used; give NAME")
    removed = asyncio.run(remove_plate(client.mqtt, name, force=arguments.force))
    if not arguments.json:
        sys.stdout.write(f"{printable(name)} removed; retained topics cleared: {', '.join(map(printable, removed))}\n")
    return finish(arguments, {"name": name, "removed": list(removed)})
