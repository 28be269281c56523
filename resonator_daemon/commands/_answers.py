"""Commands to a running daemon over MQTT, and its answers as text or JSON."""

import json
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.base.host.text import printable
from resonator_daemon.tools.command_line.output import print_json

if TYPE_CHECKING:
    from resonator_daemon.board.config.clients import Client

_AGAIN_S: Final = 0.5


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

    from resonator_daemon.mqtt.daemon_search import find_daemon
    from resonator_daemon.mqtt.requests import reach, request

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
        raise RefusedError(str(reasons.get("code", RefusedError.code)), message, so_far=kept)
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
