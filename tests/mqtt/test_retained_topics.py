"""Messages of other clients on retained topics and on topics of commands."""

import json

import pytest
from mqtt_helpers import LEFT, Messages, publishing, until
from observer import observe, skipping

from resonator_daemon.mqtt import topics
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.message_account import Account
from resonator_daemon.mqtt.outbox import QUIET_S, RetainedTopics
from resonator_daemon.mqtt.packets import Packet, pack
from resonator_daemon.mqtt.publisher import Subscription

LINK, SENSOR = f"{LEFT}/state/link", f"{LEFT}/state/sensor"


def foreign(topic: str, payload: bytes = b"junk") -> Incoming:
    return Incoming(topic, payload, False, None, None)


async def test_many_foreign_messages_cause_few_restorations(monkeypatch: pytest.MonkeyPatch) -> None:
    restored: list[str] = []
    retained = RetainedTopics(Account(), lambda: None, restored.append)
    skip = skipping(monkeypatch)
    for topic in (LINK, SENSOR):
        retained.put(Packet(topic, b"{}", pack()))
    for number in range(400):  # in 8 s
        retained.receive(foreign(LINK, b"junk %d" % number))
        await skip(0.02)
    assert restored == [LINK] * 2
    await skip(30.0)
    assert restored == [LINK] * 3
    for seconds, count in ((59.0, 3), (1.0, 4), (60.0, 5), (QUIET_S, 6), (0.0, 6), (60.0, 7)):
        retained.receive(foreign(LINK))
        await skip(seconds)
        assert len(restored) == count
    await skip(QUIET_S)
    for seconds in (0.0, 5.0):  # the pauses begin again
        retained.receive(foreign(LINK))
        await skip(seconds)
    assert restored == [LINK] * 9
    retained.receive(foreign(LINK))
    retained.put(Packet(LINK, b"{}", pack()))  # is newer
    await skip(60.0)
    for topic in (LINK, SENSOR):
        retained.receive(foreign(topic))
    retained.restore_now()  # as after another daemon has ended
    assert restored[9:] == [LINK, SENSOR]
    retained.receive(foreign(LINK))
    retained.close()
    await skip(60.0)
    assert len(restored) == 11


async def test_own_messages_that_come_back_are_not_restored(broker) -> None:
    """Also on a topic with another subscription."""
    subscription = Subscription(LINK, 1, lambda message: None)
    async with observe(broker.url, LINK) as observer, publishing(broker.url, subscriptions=(subscription,)) as left:
        await until(lambda: left.connected)
        for number in range(4):
            left.publish(LEFT, topics.STATE_LINK, Messages.state("online", str(number)))
            await observer.until_last(LINK, reason=str(number))
        assert left.account.republished == 0


async def test_a_retained_command_is_marked_also_when_it_arrives_live(mosquitto) -> None:
    received: list[Incoming] = []
    subscription = Subscription(f"{LEFT}/cmd/+", 1, received.append, retain_as_published=True)
    async with publishing(mosquitto.url, subscriptions=(subscription,)) as left, observe(mosquitto.url, LINK) as other:
        await until(lambda: left.connected)
        await other.client.publish(f"{LEFT}/cmd/tare", json.dumps({}), qos=1, retain=True)
        await other.client.publish(f"{LEFT}/cmd/tare", b"", qos=1, retain=True)
        await other.client.publish(f"{LEFT}/cmd/ping", b"{}", qos=1)
        await until(lambda: len(received) >= 3)
    assert [message.retained for message in received] == [True, True, False]
