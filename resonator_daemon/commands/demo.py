"""Touch emulated plates and show what the daemon publishes, next to the truth.

It prints the address of a live page, where the mouse presses the plates; in a terminal it also has a live view.

Ctrl-C ends it early. It then prints the result so far and exits with 0 if nothing was lost or missed, else with 1.
Before the first frame there is no result, and it exits with 1.

Example: resonatord demo --plate quartz16 --seconds 20 --json
"""

import argparse
import logging
import sys

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.tools.command_line import check_plate_name, positive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--plate",
        action="append",
        metavar="NAME",
        help="quartz16, skin32, fingertip400 or comb16; repeat it for several (default: the first two)",
    )
    parser.add_argument("--seconds", type=positive, default=60.0, help="how long, from the first frame (default: 60)")
    parser.add_argument("--headless", action="store_true", help="no live page, and no live view in the terminal")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.tools.demo.run import DemoOptions, run_demo

    logging.getLogger().setLevel(logging.ERROR)  # view and result show the rest
    plates = tuple(arguments.plate or ("quartz16", "skin32"))
    for plate in plates:
        check_plate_name(plate)
    has_page = not (arguments.headless or arguments.json)
    has_view = has_page and sys.stdout.isatty()
    return run_demo(DemoOptions(plates, arguments.seconds, has_page=has_page, has_view=has_view, json=arguments.json))
