"""Compare two recordings: touches, forces, losses and timing.

Each is replayed with the plate and settings that it carries. Touches correspond to each other by the order of their
sites.

Example: resonatord compare before.mcap after.mcap
"""

import argparse
import logging
from pathlib import Path

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.tools.command_line import finish, named_recordings, print_page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("a", type=Path, metavar="A.mcap", help="a recording, as from before a change")
    parser.add_argument("b", type=Path, metavar="B.mcap", help="another one")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print the comparison; DifferenceError where a recording is damaged or replays otherwise than recorded."""
    from resonator_daemon.base.host.signals import interruptible
    from resonator_daemon.tools.replay.comparison import Comparison, play

    logging.getLogger().setLevel(logging.WARNING)  # connections are not logged here
    with named_recordings(), interruptible("nothing was compared"):
        compared = Comparison(play(arguments.a), play(arguments.b))
    if not arguments.json:
        print_page(compared.table())
    return finish(arguments, compared.as_json(), [*compared.a.problems, *compared.b.problems])
