"""What a subscriber of the daemon's own sees: every plate, checked payloads, across restarts of the broker."""

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import aclosing
from functools import partial

import aiomqtt
import numpy as np
import pytest
from mqtt_helpers import LEFT, Messages, publishing

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import subscriber, topics
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.subscriber import Arrival, Received, subscribe


async def next_of(received: AsyncIterator[Received], path: str) -> Received:
    async with asyncio.timeout(10):
        async for message in received:
            if message.path == path:
                return message
    raise AssertionError("the subscription ended")


async def test_messages_of_each_plate_arrive_as_objects(broker) -> None:
    async with publishing(broker.url) as left, aclosing(subscribe(Mqtt(url=broker.url))) as received:
        left.publish(LEFT, topics.STATE_LINK, Messages.state("online", "here"))
        plate, path, message = await next_of(received, "state/link")
        assert (plate, path) == ("left", "state/link")
        assert message == Messages.state("online", "here")
        left.publish(LEFT, topics.DECODED, Messages.decoded(3))
        left.publish(LEFT, topics.FORCES, Messages.forces(4))
        decoded = await next_of(received, "decoded")
        np.testing.assert_array_equal(decoded.message.traction_pascal, np.full((3, 32, 32), 3.0))
        assert (await next_of(received, "forces")).message == Messages.forces(4)


async def test_without_full_rate_the_copies_for_people_arrive_under_the_name_of_their_topic(broker) -> None:
    at = Mqtt(url=broker.url)
    async with publishing(broker.url) as left, aclosing(subscribe(at, full_rate=False)) as received:
        left.publish(LEFT, topics.STATE_LINK, Messages.state("online"))
        assert (await anext(received)).path == "state/link"
        for number in (1, 2, 3):  # of one instant: one copy of them
            left.publish(LEFT, topics.DECODED, Messages.decoded(number))
            left.publish(LEFT, topics.FORCES, Messages.forces(number))
        left.publish(LEFT, topics.HEALTH, Messages.health(9))
        arrived = [await anext(received) for _ in range(3)]
    assert {(each.path, each.message.seq) for each in arrived} == {("decoded", 1), ("forces", 1), ("health", 9)}


async def test_what_cannot_be_read_is_passed_over_and_logged(mosquitto, caplog: pytest.LogCaptureFixture) -> None:
    at = Mqtt(url=mosquitto.url)
    async with aclosing(subscribe(at)) as received, aiomqtt.Client("127.0.0.1", at.port) as client:
        topic = "resonator/left/state/link"
        await client.publish(topic, Messages.state("lost").model_dump_json(), qos=1, retain=True)
        assert (await anext(received)).message.state == "lost"
        for payload in (b"{", b'{"state": "lost"}', b""):  # the last one clears what is retained
            await client.publish(topic, payload, qos=1)
        await client.publish(topic, Messages.state("online").model_dump_json(), qos=1)
        assert (await anext(received)).message.state == "online"
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * 2
    assert "Invalid JSON" in caplog.messages[0]
    assert "name: Field required (and " in caplog.messages[1]


async def test_a_slow_reader_loses_what_is_old_of_streams_and_no_event(monkeypatch: pytest.MonkeyPatch) -> None:
    """All messages have arrived before the first is taken."""
    now_ns = time.time_ns()
    second_ns = 10**9

    def arrival(topic: topics.Topic[Message], number: int, age_ns: int) -> Arrival:
        message = Messages.event(number) if topic is topics.CONTACT_EVENT else Messages.forces(number)
        return Arrival(f"{LEFT}/{topic.path}", encode(message), now_ns - age_ns)

    arrivals = [
        arrival(topics.CONTACT_EVENT, 0, 9 * second_ns),
        *(arrival(topics.FORCES, number, 8 * second_ns - number) for number in range(1, 50)),
        arrival(topics.CONTACT_EVENT, 50, second_ns),
        *(arrival(topics.FORCES, number, -number) for number in range(51, 100)),
    ]
    monkeypatch.setattr(subscriber, "Receiver", partial(Replayed, arrivals))
    assert await numbers_of(len(arrivals) - 49) == [0, 50, *range(51, 100)]
    monkeypatch.setattr(subscriber, "STREAM_WAITING_MAX", 10)
    assert await numbers_of(12) == [0, 50, *range(90, 100)]
    monkeypatch.setattr(subscriber, "Receiver", partial(Replayed, arrivals[:50]))
    assert await numbers_of(2) == [0, 49]  # the newest of a topic is delivered, however old


class Replayed:
    """Stands for a Receiver that received these messages at once."""

    def __init__(
        self, arrivals: list[Arrival], _broker: Mqtt, _filters: object, on_arrival: object, *_: object
    ) -> None:
        self._arrivals = arrivals
        self._on_arrival = on_arrival

    def start(self) -> None:
        for arrival in self._arrivals:
            self._on_arrival(arrival)

    async def close(self) -> None:
        pass


async def numbers_of(count: int) -> list[int]:
    """Return the numbers of so many messages, all that there are."""
    async with aclosing(subscribe(Mqtt())) as received:
        return [(await anext(received)).message.seq for _ in range(count)]
