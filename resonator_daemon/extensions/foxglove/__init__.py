"""Serve what plates publish to Foxglove, over its WebSocket protocol, until stopped.

Foxglove opens ws://127.0.0.1:8765 as a "Foxglove WebSocket". With --plate the channels are those of exported
recordings; without it, the name of its plate goes before each. Any program of this computer can read, without a
password. Other computers need a tunnel, as `ssh -L`.

docs/how-to/dashboards.md explains more.

Example: resonatord bridge foxglove --url mqtt://127.0.0.1:1883 --plate left-index
"""

import argparse
from functools import partial

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.tools.command_line import add_broker, add_listen, add_published_plate, broker_of, print_url


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_broker(parser, config_is_argument=True)
    add_published_plate(parser)
    add_listen(parser, 8765, "where viewers connect, on this computer")
    parser.add_argument(
        "--decimated", action="store_true", help="at most 20 or 5 a second of each (default: all messages)"
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    import asyncio

    from resonator_daemon.board.config.tables import Listen
    from resonator_daemon.extensions.foxglove.server import serve

    listen = Listen(*arguments.listen)
    if not listen.loopback:
        raise UsageError(
            f"--listen {listen}: other computers can reach this address, and the server has no password; listen on "
            f"127.0.0.1, and there use `ssh -L {listen.port}:127.0.0.1:{listen.port} HOST` or a reverse proxy"
        )
    on_ready, full_rate = partial(print_url, "Foxglove WebSocket", as_json=arguments.json), not arguments.decimated
    asyncio.run(serve(broker_of(arguments), listen, on_ready, plate=arguments.plate, full_rate=full_rate))
    return ExitCode.DONE
