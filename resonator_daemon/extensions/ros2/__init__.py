"""Publish what plates publish as topics of ROS 2, without an installation of ROS, until stopped.

Topics are /NAME/wrench, /NAME/contacts/wrench, /NAME/decoded/cloud and others, with states on /diagnostics. Everybody
in the DDS domain can read them; CYCLONEDDS_URI names the network interface.

docs/how-to/dashboards.md explains more.

Example: resonatord bridge ros2 --url mqtt://127.0.0.1:1883 --domain-id 7
"""

import argparse
import os
import re

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.tools.command_line import add_broker, add_published_plate, broker_of, whole_number

_DOMAIN_MAX = 232  # beyond it, DDS has no ports


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_broker(parser, config_is_argument=True)
    add_published_plate(parser)
    parser.add_argument(
        "--domain-id",
        type=whole_number(0, _DOMAIN_MAX),
        metavar="N",
        help="as ROS_DOMAIN_ID (default: ROS_DOMAIN_ID, or 0)",
    )
    parser.add_argument(
        "--namespace", type=_namespace, default="", metavar="NAME", help="before the topics of plates, as /hand"
    )
    parser.add_argument("--humble", action="store_true", help="name the node as ROS 2 Humble and older ones read it")
    parser.add_argument(
        "--decimated", action="store_true", help="at most 20 or 5 a second of each (default: all messages)"
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    import asyncio

    from resonator_daemon.extensions.ros2.bridge import serve

    asyncio.run(
        serve(
            broker_of(arguments),
            _domain_from_environment() if arguments.domain_id is None else arguments.domain_id,
            plate=arguments.plate,
            namespace=arguments.namespace,
            humble=arguments.humble,
            full_rate=not arguments.decimated,
        )
    )
    return ExitCode.DONE


def _domain_from_environment() -> int:
    try:
        return whole_number(0, _DOMAIN_MAX)(os.environ.get("ROS_DOMAIN_ID") or "0")
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"ROS_DOMAIN_ID: {error}") from None


def _namespace(text: str) -> str:
    name = text.strip("/")
    if name and not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*", name):
        raise argparse.ArgumentTypeError(f"{text!r} is no namespace of ROS; use letters, digits and _, as /hand")
    return f"/{name}" if name else ""
