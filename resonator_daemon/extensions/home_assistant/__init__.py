"""List plates as devices in Home Assistant, by retained discovery messages, until stopped.

The messages stay when the command ends. A plate whose retained topics are cleared is no longer listed.

docs/how-to/dashboards.md explains more.

Example: resonatord bridge home-assistant --url mqtt://127.0.0.1:1883
"""

import argparse

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.tools.command_line import add_broker, add_published_plate, broker_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_broker(parser, config_is_argument=True)
    add_published_plate(parser)
    parser.add_argument(
        "--discovery-prefix",
        type=_topic,
        default="homeassistant",
        metavar="TOPIC",
        help="of Home Assistant's MQTT integration (default: homeassistant)",
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    import asyncio

    from resonator_daemon.extensions.home_assistant.bridge import serve

    asyncio.run(serve(broker_of(arguments), arguments.discovery_prefix, plate=arguments.plate))
    return ExitCode.DONE


def _topic(text: str) -> str:
    from resonator_daemon.board.config.mqtt import topic_prefix

    try:
        return topic_prefix(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"got {text!r}; it {error}") from None
