"""Removal of a plate that is gone for good: its retained topics are cleared."""

import asyncio
import json
from collections.abc import Collection
from typing import Final

from paho.mqtt.client import topic_matches_sub
from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.base.entry_points import load_entries
from resonator_daemon.base.errors import ExitCode, UserError
from resonator_daemon.base.reasons import Condition
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import BrokerConnection
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.reconnection import keep_connected
from resonator_daemon.mqtt.requests import BrokerUnreachableError, DeniedError, reach
from resonator_daemon.mqtt.topics import STATE_DAEMON, full_topic

QUIET_S: Final = 1.0  # retained messages come at once: after such a silence there are no more
CLEARED_S: Final = 3.0  # for one topic
RESTORED_S: Final = 2.5  # a running daemon restores its topics at once, the first time
REMOVED_S: Final = 30.0  # all of it


class NotOfflineError(UserError):
    """The daemon of the plate is running, by its state or because it restored what was cleared."""

    exit_code = ExitCode.FAILED
    code = "not_offline"


class NoPlateError(UserError):
    """The broker has no retained topic of the plate."""

    exit_code = ExitCode.FAILED
    code = "no_plate"


async def remove_plate(broker: Mqtt, name: str, *, force: bool = False) -> tuple[str, ...]:
    """Clear all retained topics below `prefix/name/`, `state/daemon` last; return their paths.

    Before them, messages of extensions that list the plate in other programs are cleared. They are returned with their
    whole topics.

    Parameters
    ----------
    broker, name
    force
        Whether to clear also where `state/daemon` is not `offline`. It is an error if a daemon restores it.

    Raises
    ------
    BrokerUnreachableError
        The broker cannot be reached, or refuses the connection.
    DeniedError
        The broker's access rules do not let this user read or clear the topics.
    NoPlateError
        Nothing is retained.
    NotOfflineError
        The daemon is not offline; without `force` nothing was cleared.
    """
    await reach(broker)
    loop = asyncio.get_running_loop()
    closing: asyncio.Future[None] = loop.create_future()
    done: asyncio.Future[None] = loop.create_future()
    listed = [discovery(broker, name, None, contacts=False) for _, discovery in load_entries("discovery", callable)]
    filters = tuple(topic for topic, _ in filter(None, listed))
    removal = _Removal(full_topic(broker.prefix, name, ""), filters, force=force)
    reported = "no answer"

    def report(_level: int, text: str) -> None:
        nonlocal reported
        reported = text

    async def serve(client: BrokerConnection, _at_once: bool) -> None:
        try:
            await removal.run(client)
        except UserError as error:
            done.set_exception(error)
        else:
            done.set_result(None)

    def make_connection(version: MQTTProtocolVersion) -> BrokerConnection:
        return BrokerConnection(broker, version, on_message=removal.receive)

    connection = asyncio.create_task(keep_connected(broker, make_connection, serve, closing, report=report))
    try:
        async with asyncio.timeout(REMOVED_S):
            await done
    except TimeoutError:
        raise BrokerUnreachableError(f"nothing was completed within {REMOVED_S:g} s; {reported}") from None
    finally:
        closing.set_result(None)
        await connection
    return tuple(removal.cleared)


class _Removal:
    """Steps of the removal; begins again on each connection."""

    def __init__(self, base: str, discovery: Collection[str], *, force: bool) -> None:
        self._base = base
        self._discovery = discovery  # filters
        self._force = force
        self._retained: dict[str, bytes] = {}  # payloads by topic
        self._cleared: list[str] = []  # topics
        self._changed = asyncio.Event()

    @property
    def cleared(self) -> list[str]:
        """Paths of what is below the base, and other topics as they are."""
        return [topic.removeprefix(self._base) for topic in self._cleared]

    def receive(self, message: Incoming) -> None:
        """Take a retained message, a live one on the same topic, or an empty one, which cleared a topic."""
        topic = message.topic
        if not (topic.startswith(self._base) or any(topic_matches_sub(each, topic) for each in self._discovery)):
            return  # amqtt 0.12 delivers retained messages of all subscriptions that it has
        if message.payload and (message.retained or topic in (*self._cleared, *self._retained)):
            self._retained[topic] = message.payload
        elif message.payload or self._retained.pop(topic, None) is None:
            return  # a stream, or what has been cleared already
        else:
            self._cleared.append(topic)
        self._changed.set()

    async def run(self, client: BrokerConnection) -> None:
        self._retained.clear()
        for topic_filter in self._discovery:
            client.subscribe(topic_filter)  # a broker that denies it has no message there that this user wrote
        if reason := await client.subscribe(f"{self._base}#"):
            raise DeniedError(f"the broker denies {self._base}# ({reason}); see its access rules for this user")
        while await self._change_within(QUIET_S):
            pass
        if not self._retained and not self._cleared:
            raise NoPlateError(f"nothing is retained below {self._base}; see the name, --prefix and the broker")
        if not self._force:
            self._require_offline()
        for topic in sorted(self._retained, key=self._order):
            client.send(topic, b"", qos=1, retain=True)
            await self._wait_until_cleared(topic)
        if self._force:
            await self._require_no_restoration()

    def _order(self, topic: str) -> tuple[bool, bool, str]:
        return topic == f"{self._base}{STATE_DAEMON.path}", topic.startswith(self._base), topic

    def _require_offline(self) -> None:
        daemon = f"{self._base}{STATE_DAEMON.path}"
        if daemon in self._retained:
            state = _state_in(self._retained[daemon])
            if state != Condition.OFFLINE:
                raise NotOfflineError(
                    f"{daemon} is {state}, must be {Condition.OFFLINE}: stop the daemon first; "
                    "if its computer is gone for good, use --force"
                )

    async def _wait_until_cleared(self, topic: str) -> None:
        """Wait until the broker delivers the empty message, which it does only where it has taken it."""
        try:
            async with asyncio.timeout(CLEARED_S):
                while topic in self._retained:
                    await self._next_change()
        except TimeoutError:
            raise DeniedError(f"the broker does not clear {topic}; see its access rules for this user") from None

    async def _require_no_restoration(self) -> None:
        try:
            async with asyncio.timeout(RESTORED_S):
                while not self._retained:
                    await self._next_change()
        except TimeoutError:
            return
        raise NotOfflineError(f"a running daemon restores {min(self._retained)}: stop it first")

    async def _change_within(self, seconds: float) -> bool:
        try:
            async with asyncio.timeout(seconds):
                await self._next_change()
        except TimeoutError:
            return False
        return True

    async def _next_change(self) -> None:
        self._changed.clear()
        await self._changed.wait()


def _state_in(payload: bytes) -> str:
    """Return the word of a state, of whichever version of the schema."""
    try:
        return str(json.loads(payload)["state"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return "unreadable"
