"""The demo's own subscription: all messages in order, whole and acknowledged, from either broker."""

import asyncio
from queue import Queue

import aiomqtt
import pytest

from resonator_daemon.base.errors import UserError
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.subscriber import Arrival
from resonator_daemon.tools.demo.subscription import Subscription


async def test_messages_of_all_sizes_arrive_whole_and_in_order(broker) -> None:
    arrivals: Queue[Arrival] = Queue()
    sent = [
        (topic, bytes([number]) * size)
        for number, size in enumerate((0, 1, 127, 128, 20_000, 300_000))
        for topic in ("a/x", "b")
    ]
    subscription = await asyncio.to_thread(Subscription, broker.url, {"a/+": 0, "b": 1}, arrivals.put)
    async with aiomqtt.Client("127.0.0.1", Mqtt(url=broker.url).port) as client:
        for topic, payload in sent:
            await client.publish(topic, payload, qos=1)
    received = [await asyncio.to_thread(arrivals.get, timeout=20) for _ in sent]
    for topic in ("a/x", "b"):
        assert [each.payload for each in received if each.topic == topic] == [p for t, p in sent if t == topic]
    assert [each.arrived_ns for each in received] == sorted(each.arrived_ns for each in received)
    await asyncio.to_thread(subscription.close)


async def test_it_publishes_beside_receiving(broker) -> None:
    arrivals: Queue[Arrival] = Queue()
    subscription = await asyncio.to_thread(Subscription, broker.url, {"a/+": 1}, arrivals.put)
    async with aiomqtt.Client("127.0.0.1", Mqtt(url=broker.url).port) as client:
        await client.publish("a/first", b"", qos=1)
    await asyncio.to_thread(arrivals.get, timeout=20)  # from here on the subscription holds
    for topic, payload in (("a/x", b"{}"), ("b", b"not subscribed"), ("a/y", b"x" * 200)):
        subscription.publish(topic, payload)
    received = [await asyncio.to_thread(arrivals.get, timeout=20) for _ in range(2)]
    assert [(each.topic, each.payload) for each in received] == [("a/x", b"{}"), ("a/y", b"x" * 200)]
    await asyncio.to_thread(subscription.close)


async def test_a_broker_that_refuses_the_demo_is_a_users_error() -> None:
    async def refuse(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"\x20\x02\x00\x05")
        writer.close()

    async with await asyncio.start_server(refuse, "127.0.0.1", 0) as server:
        url = f"mqtt://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        with pytest.raises(UserError):
            await asyncio.to_thread(Subscription, url, {"a": 0}, lambda _: None)
