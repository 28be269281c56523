"""Search for the running daemon of a configuration, by its retained messages."""

import asyncio
from contextlib import aclosing
from typing import Final

from resonator_daemon.config import Client
from resonator_daemon.errors import ConfigurationError, ExitCode, UserError
from resonator_daemon.links.table import parse_link
from resonator_daemon.publishing.payloads import Condition, Info, State
from resonator_daemon.publishing.subscriber import subscribe
from resonator_daemon.publishing.topics import INFO, STATE_DAEMON, TOPICS

LOOK_S: Final = 3.0
OTHERS_S: Final = 0.5  # for another daemon of the same link, where one of them is offline


class NoDaemonError(UserError):
    """No daemon of the configuration is online."""

    exit_code = ExitCode.FAILED
    code = "no_daemon"


async def find_daemon(config: Client) -> str:
    """Return the name of a daemon that is not offline, by its configured name, else by its link.

    Without a configured name a daemon has the serial number of its board. The broker retains `info` and the daemon's
    state, so that both arrive at once.

    Raises
    ------
    ConfigurationError
        The configuration has neither name nor link.
    NoDaemonError
        No such daemon is online.
    """
    if config.name is None and config.link is None:
        raise ConfigurationError("name: missing; give the name that the daemon publishes under, or the link it reads")
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
