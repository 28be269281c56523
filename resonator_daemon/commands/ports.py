"""List the ports that a board may be connected to, each with the line of the configuration that names it.

Example: resonatord ports
"""

import argparse
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.base.host.text import page, print_note
from resonator_daemon.tools.command_line import print_error, print_json

if TYPE_CHECKING:
    from resonator_daemon.board.links.target import FoundPort


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.board.links.carriers import all_carriers
    from resonator_daemon.board.links.link import LinkUnavailableError

    places: list[FoundPort] = []
    for carrier in all_carriers():
        try:
            places += carrier.discover()
        except LinkUnavailableError as error:
            print_error(f"{carrier.scheme} boards are not listed: {error}")
    if arguments.json:
        print_json({"verb": "ports", "ports": [_as_json(place) for place in places]})
        return ExitCode.DONE
    for place in places:
        sys.stdout.writelines(f"{line}\n" for line in _lines(place))
    if not all(place.held_by_all_seen for place in places):
        who = "sees more" if os.geteuid() else "outside of this container sees more"
        print_note(f"programs that this user may not look at are not shown as holders; root {who}")
    if not places:
        print_note("no serial port and no USB board is present; plug one in, or try: resonatord emulate --help")
    return ExitCode.DONE


def _as_json(place: "FoundPort") -> dict[str, object]:
    from dataclasses import asdict

    return {**asdict(place), "held_by": [{"pid": holder.pid, "name": holder.name} for holder in place.held_by]}


def _lines(place: "FoundPort") -> Iterator[str]:
    about = " ".join(filter(None, (place.usb_id, place.serial_number, place.description)))
    yield f"{place.device}  {about or 'no description'}"
    if place.looks_like_a_board:
        yield "    looks like a board; to be sure: resonatord identify"
    if place.held_by:
        yield f"    held by {' and '.join(str(holder) for holder in place.held_by)}"
    if not place.permitted:
        yield f"    may not be opened by this user; see {page('how-to/connect.md')}"
    yield f'    link = "{place.link}"'
