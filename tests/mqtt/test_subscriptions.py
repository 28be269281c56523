"""What a publisher listens to: on each connection, shared, denied, and whatever a message does to its taker."""

import json

import aiomqtt
import pytest
from mqtt_helpers import LEFT, Messages, publishing, scripted_broker, until
from observer import observe
from relay import relay

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import topics
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.publisher import Subscription

ONLINE = Messages.state("online", "all is well")


async def test_what_is_subscribed_to_is_heard_on_every_connection(broker) -> None:
    heard: list[Incoming] = []
    connections: list[int] = []
    mine = Subscription(f"{LEFT}/cmd/+", 1, heard.append)
    other = Subscription("resonator/+/info", 1, lambda message: pytest.fail(f"{message}"))
    async with (
        relay(broker.url) as way,
        publishing(way.url, subscriptions=(mine, other), on_connected=connections.append) as left,
    ):
        for number in (1, 2):
            await until(lambda: left.connected)
            async with aiomqtt.Client("127.0.0.1", Mqtt(url=broker.url).port) as asker:
                await asker.publish(f"{LEFT}/cmd/ping", str(number).encode())
                await until(lambda: len(heard) == number)  # noqa: B023
            way.cut()
            await until(lambda: not left.connected)
    assert [(message.topic, message.payload) for message in heard] == [
        (f"{LEFT}/cmd/ping", b"1"),
        (f"{LEFT}/cmd/ping", b"2"),
    ]
    assert connections == [1, 2]


async def test_whatever_a_message_does_its_publisher_goes_on(broker, caplog: pytest.LogCaptureFixture) -> None:
    errors = [ZeroDivisionError("by zero"), ZeroDivisionError("again"), RecursionError("too deep")]
    failing, heard = iter(errors), list[bytes]()

    def fail(message: Incoming) -> None:
        raise next(failing)

    defective = Subscription(f"{LEFT}/cmd/+", 1, fail)
    other = Subscription(f"{LEFT}/rsp/+", 1, lambda message: heard.append(message.payload))
    async with publishing(broker.url, subscriptions=(defective, other)) as left:
        await until(lambda: left.connected)
        async with aiomqtt.Client("127.0.0.1", Mqtt(url=broker.url).port) as asker:
            for number in range(len(errors)):
                await asker.publish(f"{LEFT}/cmd/ping", str(number).encode(), qos=1)
            await asker.publish(f"{LEFT}/rsp/ping", b"heard", qos=1)
        await until(lambda: heard == [b"heard"])
        assert next(failing, None) is None
        left.publish(LEFT, topics.STATE_LINK, ONLINE)
        await until(lambda: left.account.acknowledged == 1)
    logged = [record.exc_info[1] for record in caplog.records if record.exc_info]
    assert logged == [errors[0], errors[2]]
    assert caplog.text.count("a message on resonator/left/cmd/ping failed") == 2


async def test_a_subscription_that_is_denied_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    commands = Subscription(f"{LEFT}/cmd/+", 1, lambda message: None)
    async with scripted_broker() as (url, script):
        script.subscribed = 0x87
        async with publishing(url, subscriptions=(commands,)) as left:
            for connections in (2, 4):
                await until(lambda: left.connected and len(script.greetings) == connections)  # noqa: B023
                left.publish(LEFT, topics.STATE_LINK, ONLINE)
                await until(lambda: left.account.waiting == 0)
                script.hang_up()
                await until(lambda: not left.connected)
    assert caplog.text.count("broker denies resonator/left/cmd/+ (Not authorized)") == 1


async def test_a_retained_command_is_marked_also_when_it_arrives_live(mosquitto) -> None:
    received: list[Incoming] = []
    subscription = Subscription(f"{LEFT}/cmd/+", 1, received.append, retain_as_published=True)
    async with (
        publishing(mosquitto.url, subscriptions=(subscription,)) as left,
        observe(mosquitto.url, f"{LEFT}/state/link") as other,
    ):
        await until(lambda: left.connected)
        await other.client.publish(f"{LEFT}/cmd/tare", json.dumps({}), qos=1, retain=True)
        await other.client.publish(f"{LEFT}/cmd/tare", b"", qos=1, retain=True)
        await other.client.publish(f"{LEFT}/cmd/ping", b"{}", qos=1)
        await until(lambda: len(received) >= 3)
    assert [message.retained for message in received] == [True, True, False]
