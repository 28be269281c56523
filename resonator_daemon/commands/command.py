"""Send a command to a running daemon and print its answer.

docs/reference/mqtt-commands.md lists the verbs and their keys. A VALUE is JSON, or else text. A daemon executes a verb
that changes something only where `allow` in [commands] of its configuration has it.

Example: resonatord command left-index set_window window_ms=20
"""

import argparse
import json
import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.tools.command_line import add_broker, add_daemon, client_of, print_answer, send_command

if TYPE_CHECKING:
    from pydantic import BaseModel


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_daemon(parser)
    parser.add_argument("verb", metavar="VERB", help="as ping, events, tare or start_recording")
    parser.add_argument("fields", nargs="*", type=_field, metavar="KEY=VALUE", help="fields of the command")
    add_broker(parser)
    parser.add_argument("--json", action="store_true", help="print the daemon's answer as one JSON object")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print the answer; FAILED where the command was refused."""
    import asyncio

    from resonator_daemon.base.toml import nearest
    from resonator_daemon.mqtt.verbs import VERBS

    logging.getLogger().setLevel(logging.WARNING)  # connections are not logged here
    verb = VERBS.get(arguments.verb)
    if verb is None:
        raise UsageError(f"VERB: got {arguments.verb!r}; {nearest(arguments.verb, list(VERBS))}")
    client, payload = client_of(arguments), _payload(verb.request, arguments.fields)
    answer = asyncio.run(send_command(client, verb.name, payload))
    return print_answer(answer, f"{verb.name} not done", as_json=arguments.json)


def _payload(model: "type[BaseModel]", fields: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Return the fields with values of JSON; as text where they are none, or the command takes text alone."""
    from pydantic import ValidationError

    payload = {key: _value(text) for key, text in fields}
    try:
        model.model_validate(payload)
    except ValidationError as error:
        wrong = {found["loc"][0] for found in error.errors() if found["type"] == "string_type"}
        payload |= {key: text for key, text in fields if key in wrong}
    return payload


def _field(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not key or not equals:
        raise argparse.ArgumentTypeError(f"got {text!r}; give KEY=VALUE, as window_ms=20")
    return key, value


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text
