"""Stop the services, and remove the files that `resonatord install` put into their places.

A file that was changed here is kept. Configurations, recordings, states and the user stay.

Example: resonatord uninstall --dry-run
"""

import argparse
from pathlib import Path

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.commands._installation import made_files, report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dry-run", action="store_true", help="print what would be done, and do nothing")
    parser.add_argument("--prefix", type=Path, metavar="DIR", help="remove below it, and run nothing: of an image")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.base.host.install import uninstall

    done = uninstall(arguments.prefix, made_files(), dry_run=arguments.dry_run)
    return report("uninstall", done, arguments.prefix, dry_run=arguments.dry_run, as_json=arguments.json)
