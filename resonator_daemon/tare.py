"""`resonatord tare`: asks the running daemon to take the present readings as untouched."""

import asyncio
import json
import sys
from contextlib import aclosing
from pathlib import Path
from typing import Final

from resonator_daemon.config import Config, load_config, parse_link
from resonator_daemon.errors import ConfigError, ExitCode
from resonator_daemon.publishing.payloads import Info
from resonator_daemon.publishing.requests import reach, request
from resonator_daemon.publishing.subscriber import subscribe
from resonator_daemon.publishing.topics import INFO, TOPICS

LOOK_S: Final = 3.0


def tare(config_path: Path, *, as_json: bool) -> ExitCode:
    """Ask, and print what the daemon did or why it did not.

    Raises
    ------
    OperatorError
        The configuration cannot be used; no broker, no daemon, or no answer.
    """
    config = load_config(config_path)
    answer = asyncio.run(_ask(config))
    done = answer.get("ok") is True
    if as_json:
        sys.stdout.write(json.dumps(answer) + "\n")
    elif done:
        sys.stdout.write(f"{answer.get('did', 'done')}\n")
    if not done:
        error = answer.get("error")
        told = error if isinstance(error, dict) else {}
        parts = [str(told[key]) for key in ("message", "hint") if told.get(key)]
        sys.stderr.write(f"resonatord: not tared: {'; '.join(parts) or 'refused'}\n")
    return ExitCode.DONE if done else ExitCode.FAILED


async def _ask(config: Config) -> dict[str, object]:
    await reach(config.mqtt)
    return await request(config.mqtt, config.name or await _name(config), "tare", {})


async def _name(config: Config) -> str:
    """Find the daemon by its link: without a name it bears the board's serial number."""
    try:
        async with asyncio.timeout(LOOK_S), aclosing(subscribe(config.mqtt, (TOPICS[INFO.path],))) as messages:
            async for plate, _, message in messages:
                if isinstance(message, Info) and parse_link(message.link) == config.link:
                    return plate
    except TimeoutError:
        pass
    raise ConfigError(f"no daemon below {config.mqtt.prefix}/ publishes of this link; start it, or set name")
