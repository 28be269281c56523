"""The publisher's contract on Mosquitto (MQTT 5) and the embedded broker (3.1.1), and its accounts to the message."""

import asyncio
import json
import logging

import pytest
from mqtt_helpers import IMPATIENT, LEFT, Messages, assert_exact, publishing, scripted_broker, until
from observer import observe

from resonator_daemon.mqtt import message_account, outbox, topics
from resonator_daemon.mqtt.codec import Encoded, Outgoing
from resonator_daemon.mqtt.event_log import IN_MEMORY_MAX
from resonator_daemon.mqtt.message_account import Account, Cause

PACKET_SIZE = b"\x27"  # Maximum Packet Size, 4 bytes
RECEIVE_MAXIMUM = b"\x21"  # 2 bytes
ONLINE = Messages.state("online", "all is well")


async def test_an_encoded_message_is_published_as_it_is_with_its_decimated_copies(broker) -> None:
    first, second, third = (Encoded(b"{%d}" % n, t_ns=n * 40_000_000) for n in range(3))
    async with observe(broker.url) as observer, publishing(broker.url) as left:
        await until(lambda: left.connected)
        for message in (first, second, third):  # 25 Hz
            left.publish(LEFT, topics.CONTACTS, message)
        await until(lambda: left.account.waiting == 0)
        await observer.until(lambda: len(observer.messages) >= 5)
        with pytest.raises(ValueError, match="contacts/event carries ContactEvent"):
            left.publish(LEFT, topics.CONTACT_EVENT, first)
    assert observer.raw("resonator/left/contacts") == [b"{0}", b"{1}", b"{2}"]
    assert observer.raw("resonator/left/contacts/20hz") == [b"{0}", b"{2}"]


async def test_close_says_stopped_after_everything_that_was_waiting(broker) -> None:
    async with observe(broker.url) as observer:
        async with publishing(broker.url) as left:
            left.publish(LEFT, topics.STATE_DAEMON, ONLINE)
            await until(lambda: left.connected)
            for number in range(50):
                left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
        await observer.until_last("resonator/left/state/daemon", state="offline", reason="stopped")
        await observer.until(lambda: len(observer.payloads("resonator/left/contacts/event")) == 50)
        assert not any(
            state["reason"] == "connection lost" for state in observer.payloads("resonator/left/state/daemon")
        )
    assert left.account.acknowledged == 52
    left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(1))
    left.publish(LEFT, topics.HEALTH, Messages.health(1))
    left.publish(LEFT, topics.STATE_LINK, ONLINE)
    left.answer(Outgoing("resonator/left/rsp/ping", b"{}"))
    assert left.account.dropped == {"closed": 3, "withdrawn": 1}


async def test_the_last_word_may_wait_for_a_broker_that_is_still_to_come(mosquitto) -> None:
    await mosquitto.kill()
    async with publishing(mosquitto.url) as left:
        left.publish(LEFT, topics.STATE_DAEMON, ONLINE)
        farewell = (LEFT, topics.STATE_DAEMON, Messages.state("offline", "no such plate"))
        closing = asyncio.create_task(left.close(farewell, wait_for_broker=True))
        await mosquitto.start()
        await closing
        async with observe(mosquitto.url) as observer:
            state = await observer.until_last("resonator/left/state/daemon", state="offline")
        assert state["reason"] == "no such plate"
        assert (left.account.acknowledged, left.account.dropped) == (1, {"superseded": 1})


async def test_a_broker_that_is_absent_at_start(broker, caplog: pytest.LogCaptureFixture) -> None:
    await broker.kill()
    with caplog.at_level(logging.INFO):
        async with publishing(broker.url) as left:
            left.publish(LEFT, topics.STATE_DAEMON, ONLINE)
            left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(1))
            for number in range(10):
                left.publish(LEFT, topics.HEALTH, Messages.health(number))
            assert left.counts.missed == 0
            assert left.account.waiting == 2
            await until(lambda: "trying again" in caplog.text)
            await broker.start()
            async with observe(broker.url) as observer:
                await observer.until_last("resonator/left/state/daemon", state="online")
                await observer.until_last("resonator/left/contacts/event", event="onset")
    assert left.account.dropped == {"not_connected_yet": 10}
    assert left.account.republished == 0
    assert left.account.acknowledged == 3
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]


async def test_a_message_that_the_broker_refuses_was_not_published() -> None:
    not_authorised = 0x87
    async with scripted_broker() as (url, script), publishing(url) as left:
        script.answer = lambda number: not_authorised if number == 2 else 0
        await until(lambda: left.connected)
        for number in range(3):
            left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
        await until(lambda: left.account.waiting == 0)
        assert (left.account.acknowledged, left.account.dropped) == (2, {"refused": 1})


async def test_of_too_many_messages_the_oldest_are_dropped() -> None:
    async with scripted_broker() as (url, script), publishing(url) as left:
        await until(lambda: left.connected)
        for number in range(outbox.STREAMS_WAITING_MAX + 7):
            left.publish(LEFT, topics.HEALTH, Messages.health(number))
        assert left.account.dropped == {"queue_full": 7}
        await until(lambda: left.account.written == outbox.STREAMS_WAITING_MAX)
        for number in range(IN_MEMORY_MAX + 5):
            left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
        assert left.account.dropped == {"queue_full": 12}
        await until(lambda: left.account.acknowledged == IN_MEMORY_MAX)
        for qos, first, count in ((0, 7, outbox.STREAMS_WAITING_MAX), (1, 5, IN_MEMORY_MAX)):
            numbers = [json.loads(message.payload)["seq"] for message in script.received if message.qos == qos]
            assert numbers == list(range(first, first + count))


async def test_too_large_messages_are_dropped_and_logged_once_a_topic(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with scripted_broker() as (url, script):
        script.connack = PACKET_SIZE + (2000).to_bytes(4, "big")
        async with publishing(url) as left:
            await until(lambda: left.connected)
            for number in range(3):
                left.publish(LEFT, topics.DECODED, Messages.decoded(number))
                left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
            left.retain(f"{LEFT}/schema", b"x" * 3000, topics.JSON)
            await until(lambda: left.account.waiting == 0)
            assert left.account.dropped == {"too_large": 5}  # three, the copy of the first, and the document
            assert left.account.acknowledged == 3
    warned = [line.partition(":")[0] for line in caplog.messages]
    assert warned == [f"{LEFT}/decoded", f"{LEFT}/decoded/5hz", f"{LEFT}/schema"]


async def test_no_more_messages_are_on_their_way_than_the_broker_asks_for() -> None:
    async with scripted_broker() as (url, script):
        script.connack = RECEIVE_MAXIMUM + b"\x00\x03"
        script.answer = lambda number: None
        async with publishing(url) as left:
            await until(lambda: left.connected)
            for number in range(8):
                left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
            left.publish(LEFT, topics.HEALTH, Messages.health(9))
            await until(lambda: left.account.written == 1)
            assert len(script.received) == 4
            script.hang_up()
            script.answer = lambda number: 0
            await until(lambda: left.account.acknowledged == 8)


async def test_close_does_not_wait_for_a_frozen_broker(mosquitto) -> None:
    async with publishing(mosquitto.url, times=IMPATIENT) as left:
        await until(lambda: left.connected)
        mosquitto.freeze()
        for number in range(5):
            left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
    assert left.account.unknown_at_disconnect == 6
    assert left.account.dropped == {"closed": 5}  # those events, which would have been sent once more
    mosquitto.thaw()


async def test_a_decimated_topic_has_some_of_the_messages_of_its_stream(mosquitto) -> None:
    async with observe(mosquitto.url) as observer, publishing(mosquitto.url) as left:
        await until(lambda: left.connected)
        for number in range(300):
            t_ns = 1_789_000_000_000_000_000 + number * 5_000_000  # 200 Hz
            left.publish(LEFT, topics.FORCES, Messages.forces(number).model_copy(update={"t_ns": t_ns}))
            assert_exact(left)
        await observer.until_count("resonator/left/forces", 300)
        assert observer.raw("resonator/left/forces/20hz") == observer.raw("resonator/left/forces")[::10]
        assert left.account.enqueued == 300 + 30


async def test_states_that_are_published_on_connecting_go_before_those_restored() -> None:
    async with scripted_broker() as (url, script):

        def on_connected(number: int) -> None:
            left.publish(LEFT, topics.STATE_DAEMON, Messages.state("online", f"connection {number}"))

        async with publishing(url, on_connected=on_connected) as left:
            left.publish(LEFT, topics.STATE_LINK, ONLINE)
            await until(lambda: left.account.acknowledged == 2)
            script.hang_up()
            await until(lambda: left.account.acknowledged == 4)
    reasons = [json.loads(message.payload)["reason"] for message in script.received]
    assert reasons == ["all is well", "connection 1", "connection 2", "all is well", "stopped"]
    assert left.account.republished == 1


async def test_answers_of_a_connection_that_is_over_are_withdrawn() -> None:
    async with scripted_broker() as (url, script), publishing(url) as left:
        script.answer = lambda number: None
        await until(lambda: left.connected)
        for number in range(outbox.UNACKNOWLEDGED_MAX):
            left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
        left.answer(Outgoing("asker", b"{}"))
        await until(lambda: len(script.received) == outbox.UNACKNOWLEDGED_MAX)
        script.answer = lambda number: 0
        script.hang_up()
        await until(lambda: not left.connected)
        assert left.account.dropped == {"withdrawn": 1}
        left.answer(Outgoing("asker", b"{}"))
        assert left.account.dropped == {"withdrawn": 2}
        await until(lambda: left.account.waiting == 0)
    assert "asker" not in {message.topic for message in script.received}


async def test_drops_have_one_line_a_minute(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_account, "FIRST_LINE_S", 0.01)
    account = Account()
    for _ in range(30):
        account.drop(Cause.QUEUE_FULL, "a/forces")
    account.drop(Cause.REFUSED, "a/info", 2)
    await until(lambda: bool(caplog.records))
    assert all(part in caplog.messages[0] for part in ("30 a/forces (queue_full)", "2 a/info (refused)"))
    account.drop(Cause.QUEUE_FULL, "a/forces", 5)
    await asyncio.sleep(0.03)
    assert len(caplog.records) == 1
    account.close()
    assert "5 a/forces (queue_full)" in caplog.messages[1]
