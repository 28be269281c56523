"""Serve what plates publish to Foxglove, over its WebSocket protocol, until stopped.

Foxglove opens ws://127.0.0.1:8765 as a "Foxglove WebSocket". With --plate the channels are those of exported
recordings; without it, the name of its plate goes before each. Any client that reaches the address can
read, without a password.

docs/how-to/viewers.md explains more.

Example: resonatord bridge foxglove --url mqtt://127.0.0.1:1883 --plate left-index
"""

import argparse
from contextlib import suppress

from resonator_daemon.commands._argument_types import listen_address
from resonator_daemon.commands._broker import add_broker, broker_of
from resonator_daemon.errors import ExitCode, UsageError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_broker(parser, config_is_argument=True)
    parser.add_argument("--plate", metavar="NAME", help="only this one, as it is published (default: every plate)")
    parser.add_argument(
        "--listen",
        type=listen_address,
        default="127.0.0.1:8765",
        metavar="ADDRESS:PORT",
        help="where viewers connect (default: %(default)s)",
    )
    parser.add_argument(
        "--decimated", action="store_true", help="at most 20 or 5 a second of each (default: all messages)"
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    with suppress(KeyboardInterrupt):
        import asyncio

        from resonator_daemon.bridges.foxglove_server import serve
        from resonator_daemon.config import plate_name

        if arguments.plate is not None:
            try:
                plate_name(arguments.plate)
            except ValueError as error:
                raise UsageError(f"--plate: got {arguments.plate!r}; {error}") from None
        full_rate = not arguments.decimated
        asyncio.run(serve(broker_of(arguments), arguments.listen, plate=arguments.plate, full_rate=full_rate))
    return ExitCode.DONE
