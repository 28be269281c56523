"""Remove a plate that is gone for good from discovery: clear its retained topics.

Its daemon must be offline. A plate that comes back publishes its topics again.

Example: resonatord remove left-index --url mqtt://127.0.0.1:1883
"""

import argparse
import sys
from pathlib import Path

from resonator_daemon.commands._output import print_json
from resonator_daemon.errors import ExitCode, UsageError
from resonator_daemon.host.printable import printable


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="that the plate is published under")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--url", default="mqtt://127.0.0.1:1883", help="the broker (default: mqtt://127.0.0.1:1883)")
    where.add_argument("--config", type=Path, metavar="FILE", help="whose [mqtt] names broker, prefix and credentials")
    parser.add_argument("--prefix", default="resonator", help="first level of the topics (default: resonator)")
    parser.add_argument(
        "--force",
        action="store_true",
        help="also where the daemon's last state is not offline, as when broker and computer went away together",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print which topics were cleared."""
    import asyncio

    from resonator_daemon.config import load_client, plate_name
    from resonator_daemon.publishing.removal import remove_plate
    from resonator_daemon.view.watch import broker_at

    try:
        name = plate_name(arguments.name)
    except ValueError as error:
        raise UsageError(f"NAME: got {arguments.name!r}; {error}") from None
    broker = load_client(arguments.config).mqtt if arguments.config else broker_at(arguments.url, arguments.prefix)
    removed = asyncio.run(remove_plate(broker, name, force=arguments.force))
    if arguments.json:
        print_json({"verb": "remove", "ok": True, "name": name, "removed": list(removed)})
    else:
        sys.stdout.write(f"{printable(name)} removed; retained topics cleared: {', '.join(map(printable, removed))}\n")
    return ExitCode.DONE
