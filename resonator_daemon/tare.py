"""`resonatord tare`: asks the running daemon to take the present readings as untouched."""

import asyncio
import json
import sys
from contextlib import aclosing
from pathlib import Path
from typing import Final

from resonator_daemon.config import Client, load_client, parse_link
from resonator_daemon.errors import ConfigurationError, ExitCode, UserError, failure_told
from resonator_daemon.host.printable import printable
from resonator_daemon.publishing.payloads import Condition, Info, State
from resonator_daemon.publishing.requests import reach, request
from resonator_daemon.publishing.subscriber import subscribe
from resonator_daemon.publishing.topics import INFO, STATE_DAEMON, TOPICS

LOOK_S: Final = 3.0
OTHERS_S: Final = 0.5  # for another daemon of the same link, where one of them is offline


class NoDaemonError(UserError):
    """No daemon is there to be asked."""

    exit_code = ExitCode.FAILED
    code = "no_daemon"


def tare(config_path: Path, *, as_json: bool) -> ExitCode:
    """Ask, and print what the daemon did or why it did not.

    Raises
    ------
    UserError
        The configuration cannot be used; no broker, no daemon, or no answer.
    """
    with failure_told("tare", as_json=as_json):
        config = load_client(config_path)
        if config.name is None and config.link is None:
            raise ConfigurationError(
                "name: missing; give the name that the daemon publishes under, or the link it reads"
            )
        answer = asyncio.run(_ask(config))
    done = answer.get("ok") is True
    if as_json:
        sys.stdout.write(json.dumps(answer) + "\n")
    elif done:
        sys.stdout.write(f"{printable(answer.get('did', 'done'))}\n")
    if not done:
        refusal = answer.get("error")
        reasons = refusal if isinstance(refusal, dict) else {}
        parts = [printable(reasons[key]) for key in ("message", "hint") if reasons.get(key)]
        sys.stderr.write(f"resonatord: not tared: {'; '.join(parts) or 'refused'}\n")
    return ExitCode.DONE if done else ExitCode.FAILED


async def _ask(config: Client) -> dict[str, object]:
    await reach(config.mqtt)
    return await request(config.mqtt, await _running(config), "tare", {})


async def _running(config: Client) -> str:
    """Find a daemon that is not offline by its name, or by its link: without a name it bears the board's serial number.

    The broker keeps both `info` and the daemon's state, so that they come at once.
    """
    names = {config.name} if config.name else set()
    offline: dict[str, str] = {}  # the reason, by name
    online: set[str] = set()
    topics = (TOPICS[INFO.path], TOPICS[STATE_DAEMON.path])
    try:
        async with asyncio.timeout(LOOK_S) as limit, aclosing(subscribe(config.mqtt, topics)) as messages:
            async for plate, path, message in messages:
                if isinstance(message, Info) and not config.name and parse_link(message.link) == config.link:
                    names.add(plate)
                elif isinstance(message, State) and path == STATE_DAEMON.path:
                    if message.state is Condition.OFFLINE:
                        offline[plate] = message.reason
                    else:
                        online.add(plate)
                if found := names & online:
                    return found.pop()
                if names & offline.keys():
                    if config.name:
                        break
                    others_s = asyncio.get_running_loop().time() + OTHERS_S
                    limit.reschedule(min(limit.when() or others_s, others_s))
    except TimeoutError:
        pass
    if gone := sorted(names & offline.keys()):
        raise NoDaemonError(f"daemon {gone[0]} is offline ({offline[gone[0]]}); start it: resonatord run")
    where = f"{config.mqtt.prefix}/{config.name or ''}"
    raise NoDaemonError(
        f"no daemon publishes {f'as {where}' if config.name else f'of this link below {where}'}; start it"
    )
