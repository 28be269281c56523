"""The publisher's contract on Mosquitto (MQTT 5) and the embedded broker (3.1.1), and its accounts to the message."""

import asyncio
import json
import logging
import random
import time

import pytest
from mqtt_helpers import Messages, assert_exact, publishing, scripted_broker, until
from observer import observe

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing import connection, publisher, topics
from resonator_daemon.publishing.publisher import Publisher

ONLINE = Messages.state("online", "all is well")


@pytest.fixture
def _short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "PUBLISH_TIMEOUT_S", 0.3)
    monkeypatch.setattr(connection, "CONNECT_TIMEOUT_S", 0.5)
    monkeypatch.setattr(publisher, "_WATCH_S", 0.1)


async def test_messages_reach_a_subscriber_as_they_were_made(broker) -> None:
    async with observe(broker.url) as observer, publishing(broker.url) as left:
        await until(lambda: left.connected)
        left.publish(topics.FORCES, Messages.forces(1))
        left.publish(topics.CONTACT_EVENT, Messages.event(2))
        left.publish(topics.DECODED, Messages.decoded(3))
        left.publish(topics.STATE_LINK, ONLINE)
        await observer.until(lambda: len(observer.heard) == 4)
        by_topic = {message.topic.value: message for message in observer.heard}
    assert observer.payloads("resonator/left/forces")[0]["seq"] == 1
    assert observer.payloads("resonator/left/contacts/event")[0]["contact"]["id"] == 2
    assert len(by_topic["resonator/left/decoded"].payload) > 2 * 12288


async def test_quality_of_service_and_retention_of_each_topic_on_the_wire() -> None:
    async with scripted_broker() as (url, script), publishing(url) as left:
        await until(lambda: left.connected)
        left.publish(topics.FORCES, Messages.forces(1))
        left.publish(topics.CONTACT_EVENT, Messages.event(2))
        left.publish(topics.DECODED, Messages.decoded(3))
        left.publish(topics.STATE_LINK, ONLINE)
        await until(lambda: left.account.waiting == 0)
        assert left.account.handed_to_socket == 2
        assert left.account.acknowledged == 2
    assert {message.topic: (message.qos, message.retain) for message in script.received} == {
        "resonator/left/forces": (0, False),
        "resonator/left/contacts/event": (1, False),
        "resonator/left/decoded": (0, False),
        "resonator/left/state/link": (1, True),
        "resonator/left/state/daemon": (1, True),
    }


async def test_a_late_subscriber_sees_the_last_states_and_nothing_else(broker) -> None:
    async with publishing(broker.url) as left:
        left.publish(topics.STATE_SENSOR, Messages.state("starting"))
        left.publish(topics.STATE_SENSOR, ONLINE)
        left.publish(topics.STATE_DAEMON, ONLINE)
        await until(lambda: left.connected)
        left.publish(topics.FORCES, Messages.forces(1))
        left.publish(topics.CONTACT_EVENT, Messages.event(2))
        await until(lambda: left.account.waiting == 0)
        async with observe(broker.url) as observer:
            await observer.until_last("resonator/left/state/sensor", state="online")
            await observer.until_last("resonator/left/state/daemon", state="online")
            assert len(observer.heard) == 2
            assert all(message.retain for message in observer.heard)


async def test_order_within_a_topic_is_kept(broker) -> None:
    async with observe(broker.url) as observer, publishing(broker.url) as left:
        await until(lambda: left.connected)
        for number in range(100):
            left.publish(topics.FORCES, Messages.forces(number))
            left.publish(topics.CONTACT_EVENT, Messages.event(number))
        await observer.until(lambda: len(observer.heard) == 200)
    for topic in ("forces", "contacts/event"):
        assert [message["seq"] for message in observer.payloads(f"resonator/left/{topic}")] == list(range(100))


async def test_close_says_stopped_after_everything_that_was_waiting(broker) -> None:
    async with observe(broker.url) as observer:
        async with publishing(broker.url) as left:
            left.publish(topics.STATE_DAEMON, ONLINE)
            await until(lambda: left.connected)
            for number in range(50):
                left.publish(topics.CONTACT_EVENT, Messages.event(number))
        await observer.until_last("resonator/left/state/daemon", state="offline", reason="stopped")
        await observer.until(lambda: len(observer.payloads("resonator/left/contacts/event")) == 50)
        assert not any(
            state["reason"] == "connection lost" for state in observer.payloads("resonator/left/state/daemon")
        )
    assert left.account.acknowledged == 52
    left.publish(topics.CONTACT_EVENT, Messages.event(1))
    assert left.account.dropped == 1


async def test_close_takes_leave_of_the_broker_so_that_the_will_is_not_published() -> None:
    async with scripted_broker() as (url, script):
        async with publishing(url) as left:
            await until(lambda: left.connected)
            await until(lambda: script.farewells == 1)  # that of the connection which asked for the version
        await until(lambda: script.farewells == 2)


async def test_while_closing_nothing_new_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publisher, "CLOSE_TIMEOUT_S", 0.2)
    async with scripted_broker() as (url, script), publishing(url) as left:
        script.answer = lambda number: None
        await until(lambda: left.connected)
        closing = asyncio.create_task(left.close())
        await until(lambda: left.account.made == 1)
        left.publish(topics.FORCES, Messages.forces(1))
        left.publish(topics.CONTACT_EVENT, Messages.event(1))
        assert left.account.dropped == 2
        assert not closing.done()
        await closing
    assert {message.topic for message in script.received} == {"resonator/left/state/daemon"}


async def test_the_last_will_speaks_for_a_daemon_that_vanishes(broker) -> None:
    async with observe(broker.url) as observer:
        left = Publisher(Mqtt(url=broker.url), "left", lambda reason: Messages.state("offline", reason))
        running = asyncio.create_task(left.run())
        left.publish(topics.STATE_DAEMON, ONLINE)
        await observer.until_last("resonator/left/state/daemon", state="online")
        running.cancel()
        await observer.until_last("resonator/left/state/daemon", state="offline")
        will = observer.payloads("resonator/left/state/daemon")[-1]
    assert will["reason"] == "connection lost"
    assert will["since_t_ns"] is None
    assert will["daemon_boot_id"] == "9f3c"
    async with observe(broker.url) as late:
        await late.until_last("resonator/left/state/daemon", state="offline")
        assert late.heard[0].retain


async def test_after_a_lost_connection_the_birth_comes_after_the_will(broker) -> None:
    async with observe(broker.url) as observer, publishing(broker.url) as left:
        left.publish(topics.STATE_DAEMON, ONLINE)
        await observer.until_last("resonator/left/state/daemon", state="online")
        left._client.abort()
        await observer.until_last("resonator/left/state/daemon", state="offline")
        await observer.until_last("resonator/left/state/daemon", state="online")
        await until(lambda: left.account.waiting == 0)
        assert left.account.restored == 1


async def test_a_broker_that_is_absent_at_start(broker, caplog: pytest.LogCaptureFixture) -> None:
    await broker.kill()
    with caplog.at_level(logging.INFO):
        async with publishing(broker.url) as left:
            left.publish(topics.STATE_DAEMON, ONLINE)
            left.publish(topics.CONTACT_EVENT, Messages.event(1))
            for number in range(10):
                left.publish(topics.FORCES, Messages.forces(number))
            assert left.dropped == 10
            await until(lambda: "trying again" in caplog.text)
            await broker.start()
            async with observe(broker.url) as observer:
                await observer.until_last("resonator/left/state/daemon", state="online")
                await observer.until_last("resonator/left/contacts/event", event="onset")
    assert left.account.dropped == 10
    assert left.account.restored == 0
    assert left.account.acknowledged == 3
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]


async def test_a_broker_that_is_killed_and_comes_back_empty(broker) -> None:
    async with publishing(broker.url) as left:
        left.publish(topics.STATE_DAEMON, ONLINE)
        left.publish(topics.STATE_LINK, Messages.state("starting"))
        await until(lambda: left.account.acknowledged == 2)
        await broker.kill()
        await until(lambda: not left.connected)
        left.publish(topics.STATE_LINK, Messages.state("stalled"))
        left.publish(topics.STATE_LINK, Messages.state("lost"))
        left.publish(topics.CONTACT_EVENT, Messages.event(1))
        left.publish(topics.FORCES, Messages.forces(1))
        assert_exact(left)
        assert left.account.waiting == 2
        assert left.account.dropped == 2
        assert left.dropped == 1  # nobody misses the state that a newer one replaced
        await broker.start()
        async with observe(broker.url) as observer:
            await observer.until_last("resonator/left/state/daemon", state="online")
            await observer.until_last("resonator/left/state/link", state="lost")
            await observer.until_last("resonator/left/contacts/event", event="onset")
            await until(lambda: left.account.waiting == 0)
        account = left.account
        assert (account.made, account.restored, account.acknowledged, account.dropped) == (7, 1, 5, 2)
        assert account.unknown_at_disconnect == 0


@pytest.mark.usefixtures("_short_timeouts")
async def test_a_frozen_broker_stalls_nobody_and_every_message_is_accounted_for(mosquitto) -> None:
    async with publishing(mosquitto.url) as left:
        left.publish(topics.STATE_DAEMON, ONLINE)
        await until(lambda: left.account.acknowledged == 1)
        mosquitto.freeze()
        longest_s = 0.0
        number = 0
        while left.connected:
            for _ in range(10):
                before = time.thread_time()
                left.publish(topics.DECODED, Messages.decoded(number))
                left.publish(topics.CONTACT_EVENT, Messages.event(number))
                longest_s = max(longest_s, time.thread_time() - before)
                assert_exact(left)
                assert left.account.waiting <= publisher.STREAMS_WAITING_MAX + publisher.EVENTS_WAITING_MAX + 11
                number += 1
            await asyncio.sleep(0)
        assert longest_s < 0.1
        frozen = left.account
        assert frozen.acknowledged == 1
        assert frozen.unknown_at_disconnect == publisher.UNACKNOWLEDGED_MAX + 1  # one stream was half written
        assert frozen.handed_to_socket + frozen.dropped + frozen.waiting + frozen.unknown_at_disconnect == 2 * number
        assert frozen.handed_to_socket < number / 2
        mosquitto.thaw()
        await until(lambda: left.account.waiting == 0)
        assert left.account.dropped == 2 * number - frozen.handed_to_socket - frozen.unknown_at_disconnect - min(
            number - publisher.UNACKNOWLEDGED_MAX, publisher.EVENTS_WAITING_MAX
        )
        async with observe(mosquitto.url) as observer:  # the old connection's will did not have the last word
            await observer.until_last("resonator/left/state/daemon", state="online")
            assert len(observer.heard) == 1


async def test_a_frozen_broker_is_noticed_though_the_socket_still_takes_everything(
    mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "KEEPALIVE_S", 1)
    async with publishing(mosquitto.url) as left:
        await until(lambda: left.connected)
        mosquitto.freeze()
        left.publish(topics.FORCES, Messages.forces(1))
        await until(lambda: not left.connected)
        assert left.account.handed_to_socket == 1
        await mosquitto.kill()


async def test_accounts_are_exact_at_random_instants_while_connections_break(broker) -> None:
    chance = random.Random(20)
    async with publishing(broker.url) as left:
        left.publish(topics.STATE_DAEMON, ONLINE)
        made = 1
        connections = 0
        for number in range(10_000):
            what = chance.random()
            if what < 0.70:
                left.publish(topics.FORCES, Messages.forces(number))
            elif what < 0.97:
                left.publish(topics.CONTACT_EVENT, Messages.event(number))
            else:
                left.publish(topics.STATE_SENSOR, Messages.state("online", str(number)))
            made += 1
            if chance.random() < 0.05:
                await asyncio.sleep(0)
            if number % 2000 == 500:
                await until(lambda: left.connected)
            if number % 2000 == 1000:
                connections += 1
                left._client.abort()
            assert left.account.made - left.account.restored == made
            assert_exact(left)
        await until(lambda: left.account.waiting == 0)
    assert connections == 5
    assert left.account.acknowledged > 0
    assert left.account.handed_to_socket > 0
    assert left.account.dropped > 0
    assert left.account.unknown_at_disconnect > 0


async def test_acknowledged_and_unknown_are_told_apart_to_the_message() -> None:
    async with scripted_broker() as (url, script), publishing(url) as left:
        script.answer = lambda number: 0 if number <= 3 else None
        await until(lambda: left.connected)
        for number in range(8):
            left.publish(topics.CONTACT_EVENT, Messages.event(number))
        await until(lambda: len(script.received) == 8 and left.account.acknowledged == 3)
        assert left.account.waiting == 5
        script.hang_up()
        await until(lambda: not left.connected)
        assert left.account.unknown_at_disconnect == 5
        assert left.account.acknowledged == 3
        script.answer = lambda number: 0
        await until(lambda: left.connected)
        left.publish(topics.CONTACT_EVENT, Messages.event(8))
        await until(lambda: left.account.waiting == 0)
        assert len(script.received) == 9
        assert left.account.acknowledged == 4


async def test_a_message_that_the_broker_refuses_was_not_published() -> None:
    not_authorised = 0x87
    async with scripted_broker() as (url, script), publishing(url) as left:
        script.answer = lambda number: not_authorised if number == 2 else 0
        await until(lambda: left.connected)
        for number in range(3):
            left.publish(topics.CONTACT_EVENT, Messages.event(number))
        await until(lambda: left.account.waiting == 0)
        assert (left.account.acknowledged, left.account.dropped) == (2, 1)


async def test_acknowledgements_that_do_not_come_delay_no_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publisher, "CLOSE_TIMEOUT_S", 0.1)
    async with scripted_broker() as (url, script), publishing(url) as left:
        script.answer = lambda number: None
        await until(lambda: left.connected)
        for number in range(100):
            left.publish(topics.CONTACT_EVENT, Messages.event(number))
            left.publish(topics.FORCES, Messages.forces(number))
        await until(lambda: len(script.received) == 100 + publisher.UNACKNOWLEDGED_MAX)
        assert left.account.handed_to_socket == 100
        assert left.account.waiting == 100


@pytest.mark.usefixtures("_short_timeouts")
async def test_a_broker_that_never_acknowledges_is_given_up(caplog: pytest.LogCaptureFixture) -> None:
    async with scripted_broker() as (url, script), publishing(url) as left:
        script.answer = lambda number: None
        await until(lambda: left.connected)
        left.publish(topics.CONTACT_EVENT, Messages.event(1))
        await until(lambda: left.account.unknown_at_disconnect == 1)
        await until(lambda: "no answer; trying again" in caplog.text)
        script.answer = lambda number: 0
        await until(lambda: left.connected)


async def test_of_too_many_messages_the_oldest_are_dropped() -> None:
    async with scripted_broker() as (url, script), publishing(url) as left:
        await until(lambda: left.connected)
        for number in range(publisher.STREAMS_WAITING_MAX + 7):
            left.publish(topics.FORCES, Messages.forces(number))
        assert left.account.dropped == 7
        await until(lambda: left.account.handed_to_socket == publisher.STREAMS_WAITING_MAX)
        for number in range(publisher.EVENTS_WAITING_MAX + 5):
            left.publish(topics.CONTACT_EVENT, Messages.event(number))
        assert left.account.dropped == 12
        await until(lambda: left.account.acknowledged == publisher.EVENTS_WAITING_MAX)
        for qos, first, count in ((0, 7, publisher.STREAMS_WAITING_MAX), (1, 5, publisher.EVENTS_WAITING_MAX)):
            numbers = [json.loads(message.payload)["seq"] for message in script.received if message.qos == qos]
            assert numbers == list(range(first, first + count))


async def test_a_topic_takes_its_own_payload_only() -> None:
    left = Publisher(Mqtt(), "left", lambda reason: Messages.state("offline", reason))
    with pytest.raises(ValueError, match="forces carries Forces, not State"):
        left.publish(topics.FORCES, ONLINE)
    assert left.account.made == 0


async def test_close_without_a_broker_returns_at_once() -> None:
    async with asyncio.timeout(1), publishing("mqtt://127.0.0.1:9") as left:
        left.publish(topics.CONTACT_EVENT, Messages.event(1))
    assert left.account.dropped == 2


@pytest.mark.usefixtures("_short_timeouts")
async def test_close_does_not_wait_for_a_frozen_broker(mosquitto, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publisher, "CLOSE_TIMEOUT_S", 0.1)
    async with publishing(mosquitto.url) as left:
        await until(lambda: left.connected)
        mosquitto.freeze()
        for number in range(5):
            left.publish(topics.CONTACT_EVENT, Messages.event(number))
    assert left.account.unknown_at_disconnect == 6
    mosquitto.thaw()
