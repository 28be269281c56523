"""Show live what plates publish.

Example: resonatord watch --url mqtt://127.0.0.1:1883
"""

import argparse
from contextlib import suppress
from pathlib import Path

from resonator_daemon.errors import ExitCode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--url", default="mqtt://127.0.0.1:1883", help="the broker (default: mqtt://127.0.0.1:1883)")
    where.add_argument("--config", type=Path, metavar="FILE", help="whose [mqtt] names broker, prefix and credentials")
    parser.add_argument("--prefix", default="resonator", help="first level of the topics (default: resonator)")
    parser.add_argument(
        "--full-rate", action="store_true", help="all messages as they come (default: at most 20 or 5 a second of each)"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a message on stdout")


def run(arguments: argparse.Namespace) -> ExitCode:
    with suppress(KeyboardInterrupt):
        import asyncio

        from resonator_daemon.config import load_client
        from resonator_daemon.view.watch import broker_at, watch

        broker = load_client(arguments.config).mqtt if arguments.config else broker_at(arguments.url, arguments.prefix)
        asyncio.run(watch(broker, as_json=arguments.json, full_rate=arguments.full_rate))
    return ExitCode.DONE
