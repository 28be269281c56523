"""Receives messages of every plate below a prefix, across restarts of the broker."""

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, Collection
from typing import Final, NamedTuple

import aiomqtt

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.codec import decode
from resonator_daemon.publishing.connection import BrokerClient, keep_connected
from resonator_daemon.publishing.mqtt_messages import Incoming
from resonator_daemon.publishing.payloads import Message
from resonator_daemon.publishing.topics import TOPICS, Topic, full_topic, split_topic

RECEIVED_MAX: Final = 1024  # a reader that does not keep up loses the oldest

log = logging.getLogger(__name__)

_BY_PATH: Final = TOPICS | {topic.slow_path: topic for topic in TOPICS.values() if topic.slow_hz is not None}


class Received(NamedTuple):
    """A message, from which plate and on which topic below it; of a decimated copy the topic that it was taken from."""

    plate: str
    path: str
    message: Message


async def subscribe(
    broker: Mqtt, topics: Collection[Topic[Message]] = tuple(TOPICS.values()), *, full_rate: bool = True
) -> AsyncGenerator[Received]:
    """Yield messages of all plates below the broker's prefix as they come, the retained ones first, for ever.

    Without `full_rate`, of topics that have a decimated copy that is taken instead. Messages that cannot be read are
    passed over and logged. To stop, close the iterator (contextlib.aclosing).
    """
    arrived = asyncio.Event()
    received: deque[tuple[str, bytes]] = deque(maxlen=RECEIVED_MAX)
    closing = asyncio.get_running_loop().create_future()

    def on_message(message: Incoming) -> None:
        received.append((message.topic, message.payload))
        arrived.set()

    def make_client(version: aiomqtt.ProtocolVersion) -> BrokerClient:
        return BrokerClient(broker, version, on_message=on_message)

    async def serve(client: BrokerClient) -> None:
        # Retained topics last: whoever has seen a state misses nothing of what is sent from then on.
        for topic in sorted(topics, key=lambda topic: topic.retained):
            path = topic.path if full_rate or topic.slow_hz is None else topic.slow_path
            await client.subscribe(full_topic(broker.prefix, "+", path), qos=topic.qos)
        # Not for ever: up to Python 3.11, a cancellation that meets the acknowledgement of a subscription is lost.
        await asyncio.wait([client.lost, closing], return_when=asyncio.FIRST_COMPLETED)

    connection = asyncio.create_task(keep_connected(broker, make_client, serve, closing))
    connection.add_done_callback(lambda _: arrived.set())  # it ends by a defect only, which must not look like silence
    try:
        while not connection.done():
            await arrived.wait()
            arrived.clear()
            while received:
                message = _read(broker.prefix, *received.popleft())
                if message is not None:
                    yield message
    finally:
        closing.set_result(None)
        await connection


def _read(prefix: str, topic: str, payload: bytes) -> Received | None:
    plate, path = split_topic(prefix, topic)
    kind = _BY_PATH[path]
    try:
        return Received(plate, kind.path, decode(kind.payload, payload))
    except (ValueError, RecursionError, OverflowError) as error:
        log.warning("%s: message cannot be read: %s", topic, str(error).partition("\n")[0])
        return None
