"""Show forces, contacts and states of the plates at a broker, live, until stopped.

A terminal shows a page, with the largest force of the last 30 s where there is room; a pipe gets lines of text. A plate
appears as soon as its daemon (`resonatord run`) publishes.

Example: resonatord watch --url mqtt://127.0.0.1:1883
"""

import argparse

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.tools.command_line import add_broker, add_published_plate, broker_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_broker(parser, config_is_argument=True)
    add_published_plate(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object a message on stdout")


def run(arguments: argparse.Namespace) -> ExitCode:
    import asyncio

    from resonator_daemon.tools.view.watch import watch

    asyncio.run(watch(broker_of(arguments), arguments.plate, as_json=arguments.json))
    return ExitCode.DONE
