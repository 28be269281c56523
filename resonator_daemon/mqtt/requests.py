"""The other side of commands: finds a running daemon, sends it a command and waits for its answer."""

import asyncio
import json
import secrets
from collections.abc import Mapping
from contextlib import aclosing, suppress
from typing import Any, Final

from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.base.errors import ConfigurationError, ExitCode, UserError
from resonator_daemon.board.config.clients import Client
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.mqtt.broker_connection import FAILURE, MQTT_5, BrokerConnection, ConnectionTimes
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.connecting import BrokerError
from resonator_daemon.mqtt.payloads import Condition, Info, State
from resonator_daemon.mqtt.reconnection import find_version, keep_connected
from resonator_daemon.mqtt.subscriber import subscribe
from resonator_daemon.mqtt.topics import INFO, STATE_DAEMON, TOPICS, full_topic
from resonator_daemon.mqtt.verbs import UNKNOWN, VERBS, Answer, Refusal

REACH_S: Final = 5.0
ANSWER_S: Final = 10.0


class BrokerUnreachableError(UserError):
    """No broker listens at the address of the configuration or the command line."""

    exit_code = ExitCode.UNAVAILABLE
    code = "no_broker"


class NoAnswerError(UserError):
    """The daemon does not answer."""

    exit_code = ExitCode.FAILED
    code = "no_answer"


class RefusedError(UserError):
    """The daemon refused the command; `code` is one of `verbs.ErrorCode`."""

    exit_code = ExitCode.FAILED
    code = "refused"

    def __init__(self, code: str, message: str, partial_result: Mapping[str, Any] | None = None) -> None:
        super().__init__(message, partial_result=partial_result)
        self.code = code


class DeniedError(UserError):
    """The broker's access rules do not let this user send the command, or receive the answer."""

    exit_code = ExitCode.FAILED
    code = "denied"


async def reach(broker: Mqtt) -> None:
    """Connect once, and disconnect: other clients would wait for a broker for ever.

    A broker that refuses the user is one; the connection that follows reports it.

    Raises
    ------
    BrokerUnreachableError
        Nobody listens there, or what does is no broker.
    """
    times = ConnectionTimes(connect_s=REACH_S)
    try:
        version = await find_version(broker, asyncio.get_running_loop().create_future(), times)
        if broker.username is not None and version is not None:  # without a user, it may have been no answer
            connection = BrokerConnection(broker, version, times=times)
            await connection.connect()
            await connection.disconnect()
    except BrokerError as error:
        if error.code is None:
            see = "" if broker.named_by in str(error) else f"; see {broker.named_by}"
            raise BrokerUnreachableError(f"no broker at {broker.host}:{broker.port} ({error}){see}") from None


async def execute(
    broker: Mqtt, name: str, verb: str, arguments: Mapping[str, Any], *, answer_s: float = ANSWER_S
) -> Answer:
    """Send a command as `request` does; return its answer as a model.

    Raises
    ------
    RefusedError
        The daemon did not do it.
    """
    content = await request(broker, name, verb, dict(arguments), answer_s=answer_s)
    if content.get("ok") is not True:
        problem = Refusal.model_validate(content).error
        hint = f"; {problem.hint}" if problem.hint else ""
        raise RefusedError(problem.code, f"{name} refused {verb}: {problem.message}{hint} ({problem.code})")
    return (VERBS[verb].answer if verb in VERBS else Answer).model_validate(content)


async def request(
    broker: Mqtt, name: str, verb: str, payload: dict[str, Any], *, answer_s: float = ANSWER_S
) -> dict[str, Any]:
    """Send a command to the daemon of this name; return its answer.

    A connection that ends meanwhile is made again and the command sent again: the daemon may get it twice. The answer
    is recognised by its `id`, that of the payload, or else a random one.

    Raises
    ------
    BrokerUnreachableError
        Nobody listens at the broker's address.
    DeniedError
        The broker refuses this to the user; without MQTT 5 it does not report that of the command.
    NoAnswerError
        No answer came in time.
    """
    await reach(broker)
    loop = asyncio.get_running_loop()
    closing: asyncio.Future[None] = loop.create_future()
    answer: asyncio.Future[dict[str, Any]] = loop.create_future()
    number = secrets.token_hex(8)
    command_topic = full_topic(broker.prefix, name, f"cmd/{verb}")
    common_topic = full_topic(broker.prefix, name, f"rsp/{verb if verb in VERBS else UNKNOWN}")
    own_topic = f"{common_topic}/{number}"
    payload = {"id": number, **payload}

    def receive(message: Incoming) -> None:
        try:
            content = json.loads(message.payload)
        except (ValueError, RecursionError):
            return
        if message.retained or answer.done() or not isinstance(content, dict):
            return
        if content.get("verb") not in (verb, UNKNOWN):
            return
        if content.get("id") == payload["id"] or message.topic == own_topic:  # a payload that cannot be read has no id
            answer.set_result(content)

    def denied(topic: str) -> None:
        if not answer.done():
            answer.set_exception(DeniedError(f"the broker denies {topic}; see its access rules for this user"))

    async def serve(client: BrokerConnection) -> None:
        client.subscribe(own_topic if client.version is MQTT_5 else common_topic)
        client.send(
            command_topic, json.dumps(payload).encode(), qos=1, correlation=number.encode(), response_topic=own_topic
        )

    def make_connection(version: MQTTProtocolVersion) -> BrokerConnection:
        return BrokerConnection(
            broker,
            version,
            on_completed=lambda _sent, reason_code: denied(command_topic) if reason_code >= FAILURE else None,
            on_message=receive,
            on_denied=lambda topic_filter, _reason: denied(topic_filter),
        )

    connection = asyncio.create_task(keep_connected(broker, make_connection, serve, closing))
    try:
        async with asyncio.timeout(answer_s):
            return await answer
    except TimeoutError:
        raise NoAnswerError(
            f"no answer to {command_topic} within {answer_s:g} s; is `resonatord run` running?"
        ) from None
    finally:
        closing.set_result(None)
        await connection


LOOK_S: Final = 3.0


class NoDaemonError(UserError):
    """No daemon of the configuration is online."""

    exit_code = ExitCode.FAILED
    code = "no_daemon"


async def find_plate(broker: Mqtt, name: str, look_s: float | None = None) -> State:
    """Return the state of the daemon that publishes under a name, or did; the broker retains it.

    Parameters
    ----------
    look_s
        Time to wait; None: `LOOK_S`.

    Raises
    ------
    NoDaemonError
        None has published under it.
    """
    others = set()
    subscribed = subscribe(broker, (TOPICS[STATE_DAEMON.path],))
    with suppress(TimeoutError):
        async with asyncio.timeout(LOOK_S if look_s is None else look_s), aclosing(subscribed) as messages:
            async for plate, _, message in messages:
                if plate == name and isinstance(message, State):
                    return message
                others.add(plate)
    there = f"these names are there: {', '.join(sorted(others))}" if others else "no other is there"
    where = f"{broker.prefix}/{name} at {broker.host}:{broker.port}"
    raise NoDaemonError(f"no daemon publishes as {where}; {there}; start it: resonatord run")


async def find_online(broker: Mqtt, name: str) -> None:
    """Check that the daemon of a name is online. Raises NoDaemonError."""
    state = await find_plate(broker, name)
    if state.state is Condition.OFFLINE:
        raise NoDaemonError(f"daemon {name} is offline ({state.reason}); start it: resonatord run")


async def find_daemon(config: Client) -> str:
    """Return the name of a daemon that is not offline, by its configured name, else by its link.

    Without a configured name a daemon has the serial number of its board. The broker retains `info`,
    so that it arrives at once.

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
    missing = NoDaemonError(f"no daemon publishes of this link below {config.mqtt.prefix}/; start it")
    with suppress(TimeoutError):
        async with asyncio.timeout(LOOK_S), aclosing(subscribe(config.mqtt, (TOPICS[INFO.path],))) as messages:
            async for plate, _, message in messages:
                if not isinstance(message, Info) or not _is_of(config.link, message.link):
                    continue
                try:
                    await find_online(config.mqtt, plate)
                except NoDaemonError as error:
                    missing = error  # another one may read this link
                else:
                    return plate
    raise missing


def _is_of(link: LinkTarget, published: str) -> bool:
    try:
        return parse_link(published).same_board(link)
    except ValueError:  # a later version's kind of link
        return False
