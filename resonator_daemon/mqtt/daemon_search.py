"""Search for the running daemon of a configuration, by its retained messages."""

import asyncio
from contextlib import aclosing
from typing import Final

from resonator_daemon.base.errors import ConfigurationError, ExitCode, UserError
from resonator_daemon.board.config.clients import Client
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.mqtt.payloads import Condition, Info, State
from resonator_daemon.mqtt.subscriber import subscribe
from resonator_daemon.mqtt.topics import INFO, STATE_DAEMON, TOPICS

LOOK_S: Final = 3.0
OTHERS_S: Final = 0.5  # for another daemon of the same link, where one of them is offline


class NoDaemonError(UserError):
    """No daemon of the configuration is online."""

    exit_code = ExitCode.FAILED
    code = "no_daemon"


async def find_plate(broker: Mqtt, name: str) -> State:
    """Return the state of the daemon that publishes under a name, or did; the broker retains it.

    Raises
    ------
    NoDaemonError
        None has published under it.
    """
    others = set()
    try:
        async with asyncio.timeout(LOOK_S), aclosing(subscribe(broker, (TOPICS[STATE_DAEMON.path],))) as messages:
            async for plate, _, message in messages:
                if plate == name and isinstance(message, State):
                    return message
                others.add(plate)
    except TimeoutError:
        pass
    there = f"these names are there: {', '.join(sorted(others))}" if others else "no other is there"
    where = f"{broker.prefix}/{name} at {broker.host}:{broker.port}"
    raise NoDaemonError(f"no daemon publishes as {where}; {there}; start it: resonatord run")


async def find_online(broker: Mqtt, name: str) -> None:
    """Check that the daemon of a name is online. Raises NoDaemonError."""
    state = await find_plate(broker, name)
    if state.state is Condition.OFFLINE:
        raise _offline(name, state.reason)


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
    if config.name is not None:
        await find_online(config.mqtt, config.name)
        return config.name
    if config.link is None:
        raise ConfigurationError("name: missing; give the name that the daemon publishes under, or the link it reads")
    names: set[str] = set()
    offline: dict[str, str] = {}  # the reason, by name
    online: set[str] = set()
    topics = (TOPICS[INFO.path], TOPICS[STATE_DAEMON.path])
    try:
        async with asyncio.timeout(LOOK_S) as limit, aclosing(subscribe(config.mqtt, topics)) as messages:
            async for plate, path, message in messages:
                if isinstance(message, Info) and parse_link(message.link) == config.link:
                    names.add(plate)
                elif isinstance(message, State) and path == STATE_DAEMON.path:
                    if message.state is Condition.OFFLINE:
                        offline[plate] = message.reason
                    else:
                        online.add(plate)
                if found := names & online:
                    return found.pop()
                if names & offline.keys():
                    others_s = asyncio.get_running_loop().time() + OTHERS_S
                    limit.reschedule(min(limit.when() or others_s, others_s))
    except TimeoutError:
        pass
    if gone := sorted(names & offline.keys()):
        raise _offline(gone[0], offline[gone[0]])
    raise NoDaemonError(f"no daemon publishes of this link below {config.mqtt.prefix}/; start it")


def _offline(name: str, reason: str) -> NoDaemonError:
    return NoDaemonError(f"daemon {name} is offline ({reason}); start it: resonatord run")
