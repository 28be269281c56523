"""Measure the latency from the edge at the board to the subscriber.

An emulated plate, the daemon and a broker run on this machine. The latency is the time from the last edge that is
counted for a message to the subscriber who has it.

docs/explanation/latency.md explains the figures. Example: resonatord bench latency --plate quartz16 --seconds 60
"""

import argparse
import logging

from resonator_daemon.commands._argument_types import options_of, picture, positive
from resonator_daemon.errors import ExitCode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--plate", choices=("quartz16", "skin32"), default="quartz16", help="forces, or decoded (default: quartz16)"
    )
    parser.add_argument("--seconds", type=positive, default=600.0, help="how long (default: 600)")
    parser.add_argument("--external", action="store_true", help="of skin32: with the decoding in a process of its own")
    parser.add_argument("--broker", metavar="URL", help="instead of a Mosquitto of its own, or the embedded broker")
    parser.add_argument("--picture", type=picture, metavar="FILE", help="also draw to a .svg, .png or .pdf file")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.demo.latency import LatencyOptions, bench_latency

    logging.getLogger().setLevel(logging.ERROR)  # the result shows the rest
    return bench_latency(options_of(LatencyOptions, arguments))
