"""Send a command to a running daemon and print its answer.

docs/reference/mqtt-commands.md lists the verbs and their keys. A VALUE is JSON, or else text. A daemon executes a verb
that changes something only where `allow` in [commands] of its configuration has it.

Example: resonatord command left-index set_window window_ms=20
"""

import argparse
import json
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.base.host.text import printable
from resonator_daemon.tools.command_line import add_broker, add_daemon, client_of, print_json

if TYPE_CHECKING:
    from pydantic import BaseModel

    from resonator_daemon.board.config.clients import Client

_AGAIN_S: Final = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_daemon(parser)
    parser.add_argument("verb", metavar="VERB", help="as ping, health, tare or start_recording")
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


async def send_command(
    client: "Client",
    verb: str,
    payload: Mapping[str, Any],
    *,
    wait_s: float = 0.0,
    on_wait: Callable[[Mapping[str, Any]], None] = lambda refusal: None,
) -> dict[str, Any]:
    """Send a command to the running daemon of a configuration; return its answer.

    Parameters
    ----------
    wait_s
        For which it is sent again, twice a second, while the daemon is not ready or the plate not untouched.
    on_wait
        Called with the first such refusal.

    Raises
    ------
    UserError
        There is no broker, no such daemon or no answer.
    """
    import asyncio

    from resonator_daemon.mqtt.requests import find_daemon, reach, request

    await reach(client.mqtt)
    name = await find_daemon(client)
    loop = asyncio.get_running_loop()
    until_s, waits = loop.time() + wait_s, False
    while True:
        answer = await request(client.mqtt, name, verb, dict(payload))
        if refusal_of(answer).get("code") not in ("not_ready", "not_untouched") or loop.time() >= until_s:
            return answer
        if not waits:
            waits = True
            on_wait(refusal_of(answer))
        await asyncio.sleep(_AGAIN_S)


def print_answer(answer: Mapping[str, Any], not_done: str, *, as_json: bool, only: str | None = None) -> ExitCode:
    """Print an answer, or its key `only`; raise a refusal with the words `not_done` before its reason."""
    from resonator_daemon.mqtt.requests import RefusedError

    if answer.get("ok") is not True:
        reasons = refusal_of(answer)
        parts = [str(reasons[key]) for key in ("message", "hint") if reasons.get(key)]
        message = f"{not_done}: {'; '.join(parts) or 'refused'}"
        kept = answer if reasons.keys() >= {"code", "message"} else {k: v for k, v in answer.items() if k != "error"}
        raise RefusedError(str(reasons.get("code", RefusedError.code)), message, partial_result=kept)
    if as_json:
        print_json(answer)
    elif only is not None:
        sys.stdout.write(f"{printable(answer.get(only, 'done'))}\n")
    else:
        shown = {key: value for key, value in answer.items() if key not in ("verb", "ok", "id")}
        lines = [f"{printable(key)}: {_text(value)}" for key, value in shown.items()]
        sys.stdout.writelines(f"{line}\n" for line in lines or ["done"])
    return ExitCode.DONE


def refusal_of(answer: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return code, message and hint of a refusal; nothing where the answer has none."""
    refusal = answer.get("error")
    return refusal if isinstance(refusal, dict) else {}


def _text(value: object) -> str:
    return printable(value) if isinstance(value, str) else json.dumps(value, indent=2)  # ASCII
