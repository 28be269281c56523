"""Check a configuration and its plate file; neither port nor broker is opened.

Example: resonatord check left-index.toml
"""

import argparse

from resonator_daemon.commands._argument_types import add_config
from resonator_daemon.commands._output import error_object, print_error, print_json
from resonator_daemon.errors import ExitCode, UserError
from resonator_daemon.host.printable import print_note


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "the configuration")
    parser.add_argument("--json", action="store_true", help="print the findings as one JSON object")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.config.decoder import is_decoders_own, load_decoder_config
    from resonator_daemon.daemon.config_store import load_checked

    found: UserError | None = None
    notes: tuple[str, ...] = ()
    try:
        if is_decoders_own(arguments.config):
            notes = load_decoder_config(arguments.config).mqtt.notes
        else:
            notes = load_checked(arguments.config).notes
    except UserError as error:
        found = error
    findings = found.messages if found is not None else ()
    if arguments.json:
        file = str(arguments.config)
        failed = {} if found is None else {"error": error_object(found)}
        print_json({"verb": "check", "file": file, "ok": not findings, "errors": findings, "notes": notes, **failed})
    else:
        print_error(*findings)
        for line in notes:
            print_note(f"note: {line}")
        if not findings:
            print_note(f"{arguments.config}: no errors")
    return ExitCode.CONFIG if findings else ExitCode.DONE
