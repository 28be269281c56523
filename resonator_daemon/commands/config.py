"""Print an example of the configuration file, the meaning of a key, or the JSON Schema for editors.

Example: resonatord config example --plate skin32 --link tcp://192.168.0.42:7000 > left-index.toml
"""

import argparse
import json
import shutil
import sys
from typing import Final

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.tools.command_line import print_json

_GIVEN: Final = {"plate": "plate", "link": "link", "name": "name", "broker": "url"}  # keys of the example, by option


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "what",
        choices=("example", "explain", "schema"),
        metavar="{example,explain,schema}",
        help="example: a configuration to start from; explain: what a key is, its type, default, range and an example; "
        "schema: the JSON Schema",
    )
    parser.add_argument(
        "key", nargs="?", metavar="KEY", help="of explain: as mqtt.url, or mqtt for all of that table (default: a list)"
    )
    for option, key in _GIVEN.items():
        parser.add_argument(f"--{option}", dest=key, metavar=key.upper(), help=f"of example: its value of `{key}`")
    parser.add_argument("--json", action="store_true", help="print one JSON object; of schema, in one line")


def run(arguments: argparse.Namespace) -> ExitCode:
    arguments.command = verb = f"config {arguments.what}"
    if arguments.key is not None and arguments.what != "explain":
        raise UsageError(f"{arguments.key}: {verb} takes no KEY")
    given = {key: value for key in _GIVEN.values() if (value := getattr(arguments, key)) is not None}
    if given and arguments.what != "example":
        options = ", ".join(f"--{option}" for option, key in _GIVEN.items() if key in given)
        raise UsageError(f"{verb} takes no {options}; use: resonatord config example {options}")
    if arguments.what == "explain":
        _explain(arguments.key or "", verb, as_json=arguments.json)
    elif arguments.what == "schema":
        from resonator_daemon.board.config.help import config_schema

        sys.stdout.write(json.dumps(config_schema(), indent=None if arguments.json else 2) + "\n")
    else:
        from resonator_daemon.base.host.text import with_pages
        from resonator_daemon.board.config import example_config

        text = with_pages(example_config(given))
        sys.stdout.write(json.dumps({"verb": verb, "example": text}) + "\n" if arguments.json else text)
    return ExitCode.DONE


def _explain(key: str, verb: str, *, as_json: bool) -> None:
    from resonator_daemon.board.config.help import explained, explanation, key_list

    keys = explained(key)
    if as_json:
        print_json({"verb": verb, "keys": [each._asdict() for each in keys]})
        return
    columns = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    sys.stdout.write("\n".join(explanation(each, columns) for each in keys) if key else key_list(keys, columns))
