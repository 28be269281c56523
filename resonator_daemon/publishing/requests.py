"""The other side of commands: sends one to a running daemon and waits for its answer."""

import asyncio
import json
import secrets
from typing import Any, Final

import aiomqtt

from resonator_daemon.config import Mqtt
from resonator_daemon.errors import ExitCode, OperatorError
from resonator_daemon.publishing.commands import Incoming
from resonator_daemon.publishing.connection import BrokerClient, keep_connected
from resonator_daemon.publishing.topics import full_topic

REACH_S: Final = 5.0
ANSWER_S: Final = 10.0


class BrokerUnreachableError(OperatorError):
    """No broker listens where the configuration says."""

    exit_code = ExitCode.UNAVAILABLE


class NoAnswerError(OperatorError):
    """The daemon does not answer."""

    exit_code = ExitCode.FAILED


async def reach(broker: Mqtt) -> None:
    """Open a connection once: other clients would wait for a broker for ever.

    Raises
    ------
    BrokerUnreachableError
        Nobody listens there.
    """
    try:
        async with asyncio.timeout(REACH_S):
            _, writer = await asyncio.open_connection(broker.host, broker.port)
    except (OSError, TimeoutError) as error:
        where = f"{broker.host}:{broker.port}"
        raise BrokerUnreachableError(f"no broker at {where} ({error or 'no answer'}); see mqtt.url") from None
    writer.close()


async def request(
    broker: Mqtt, name: str, verb: str, payload: dict[str, Any], *, answer_s: float = ANSWER_S
) -> dict[str, Any]:
    """Send a command to the daemon of this name; return its answer.

    Raises
    ------
    BrokerUnreachableError
        Nobody listens at the broker's address.
    NoAnswerError
        No answer came in time.
    """
    await reach(broker)
    loop = asyncio.get_running_loop()
    closing: asyncio.Future[None] = loop.create_future()
    answer: asyncio.Future[dict[str, Any]] = loop.create_future()
    number = secrets.token_hex(8)
    own_topic = full_topic(broker.prefix, name, f"rsp/{verb}/{number}")
    common_topic = full_topic(broker.prefix, name, f"rsp/{verb}")

    def take(message: Incoming) -> None:
        try:
            content = json.loads(message.payload)
        except ValueError:
            return
        if isinstance(content, dict) and not message.retained and not answer.done():
            answer.set_result(content)

    async def serve(client: BrokerClient) -> None:
        has_own = client.version is aiomqtt.ProtocolVersion.V5
        await client.subscribe(own_topic if has_own else common_topic, qos=1)
        client.send(
            full_topic(broker.prefix, name, f"cmd/{verb}"),
            json.dumps(payload).encode(),
            qos=1,
            correlation=number.encode(),
            response_topic=own_topic,
        )
        await asyncio.wait([client.lost, closing], return_when=asyncio.FIRST_COMPLETED)

    connection = asyncio.create_task(
        keep_connected(broker, lambda version: BrokerClient(broker, version, on_message=take), serve, closing)
    )
    try:
        async with asyncio.timeout(answer_s):
            return await answer
    except TimeoutError:
        where = full_topic(broker.prefix, name, f"cmd/{verb}")
        raise NoAnswerError(f"no answer to {where} within {answer_s:g} s; is `resonatord run` running?") from None
    finally:
        closing.set_result(None)
        await connection
