"""Put units, udev rules and user of the services, completion and manual pages into their places.

Example: sudo /opt/resonatord/bin/resonatord install
"""

import argparse
from pathlib import Path

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.commands._installation import made_files, report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dry-run", action="store_true", help="print what would be done, and do nothing")
    parser.add_argument("--prefix", type=Path, metavar="DIR", help="write below it, and run nothing: for an image")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.base.host.install import install

    done = install(arguments.prefix, made_files(), dry_run=arguments.dry_run)
    return report("install", done, arguments.prefix, dry_run=arguments.dry_run, as_json=arguments.json)
