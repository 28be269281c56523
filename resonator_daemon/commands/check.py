"""Check a configuration and its plate file; neither port nor broker is opened.

Example: resonatord check left-index.toml
"""

import argparse

from resonator_daemon.base.errors import ExitCode, UserError
from resonator_daemon.base.host.text import print_note
from resonator_daemon.tools.command_line import add_config, finish


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "the configuration")
    parser.add_argument("--json", action="store_true", help="print the findings as one JSON object")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.board.config.clients import is_decoders_own, load_decoder_config
    from resonator_daemon.daemon.service.config_store import load_checked

    head: dict[str, object] = {"file": str(arguments.config)}
    notes: tuple[str, ...] = ()
    try:
        if is_decoders_own(arguments.config):
            own = "this file is for `resonatord decode`; `resonatord run` also needs plate and link"
            notes = (own, *load_decoder_config(arguments.config).mqtt.notes)
        else:
            notes = load_checked(arguments.config).notes
    except UserError as error:
        error.partial_result = {**head, "errors": error.messages, "notes": ()}
        raise
    if not arguments.json:
        for line in notes:
            print_note(f"note: {line}")
        print_note(f"{arguments.config}: no errors")
    return finish(arguments, {**head, "errors": (), "notes": notes})
