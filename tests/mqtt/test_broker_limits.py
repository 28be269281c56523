"""What a broker takes is honoured, whether it says so or shows it by ending connections."""

import logging
from pathlib import Path

import pytest
from brokers import Mosquitto
from mqtt_helpers import LEFT, Messages, publishing, scripted_broker, until

from resonator_daemon.mqtt import topics
from resonator_daemon.mqtt.broker_limits import EXPIRY_S, LargestMessages
from resonator_daemon.mqtt.outbox import Packet
from resonator_daemon.mqtt.packets import pack

PACKET_SIZE = b"\x27"  # Maximum Packet Size, 4 bytes
RECEIVE_MAXIMUM = b"\x21"  # 2 bytes
MAXIMUM_QOS = b"\x24"  # 1 byte
RETAIN_AVAILABLE = b"\x25"  # 1 byte


async def test_messages_beyond_the_packet_size_are_dropped_and_said_once_per_topic(
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
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert [line.split(":")[0] for line in said] == [f"{LEFT}/decoded", f"{LEFT}/decoded/5hz", f"{LEFT}/schema"]
    assert "the broker takes 2000" in said[0]


async def test_the_packet_size_is_met_to_the_byte() -> None:
    for spare, taken in ((0, 1), (-1, 0)):
        async with scripted_broker() as (url, script):
            payload = b"x" * 500
            async with publishing(url) as left:
                await until(lambda: left.connected)
                left.retain("t", payload, topics.JSON)
                await until(lambda: len(script.received) == 1)
            (packet, *_) = script.received
            size = 1 + 2 + 2 + 1 + 2 + 1 + len(packet.properties) + len(payload)
            script.connack = PACKET_SIZE + (size + 2 + spare).to_bytes(4, "big")  # up to 2 bytes are not made use of
            script.received.clear()
            async with publishing(url) as left:
                await until(lambda: left.connected)
                left.retain("t", payload, topics.JSON)
                await until(lambda: left.account.waiting == 0)
                assert len(script.received) == taken


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


async def test_a_broker_without_acknowledgements_and_without_memory(caplog: pytest.LogCaptureFixture) -> None:
    async with scripted_broker() as (url, script):
        script.connack = MAXIMUM_QOS + b"\x00" + RETAIN_AVAILABLE + b"\x00"
        async with publishing(url) as left:
            await until(lambda: left.connected)
            left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(1))
            left.publish(LEFT, topics.STATE_LINK, Messages.state("online"))
            await until(lambda: left.account.written == 2)
            assert left.account.acknowledged == 0
    assert {(message.qos, message.retain) for message in script.received} == {(0, False)}
    assert "keeps no retained messages" in caplog.text


async def test_a_broker_that_ends_the_connection_upon_a_large_event_gets_it_twice_and_no_more(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with scripted_broker() as (url, script), publishing(url) as left:
        script.too_large_bytes = 1500
        await until(lambda: left.connected)
        large = Messages.event(1).model_copy(update={"reason": "x" * 1000})
        left.publish(LEFT, topics.CONTACT_EVENT, large)
        left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(2))
        await until(lambda: left.account.waiting == 0)
        assert left.account.dropped == {"too_large": 1}
        assert left.account.acknowledged == 1
        assert len(script.greetings) == 2 * 3
    assert caplog.text.count(f"ends the connection upon {LEFT}/contacts/event") == 1


async def test_a_broker_that_ends_the_connection_upon_a_large_stream_is_not_asked_for_ever(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with scripted_broker() as (url, script), publishing(url) as left:
        script.too_large_bytes = 20_000
        number = 0
        while not left.account.dropped.get("too_large"):
            await until(lambda: left.connected)
            left.publish(LEFT, topics.DECODED, Messages.decoded(number))
            number += 1
            await until(lambda: left.account.waiting == 0 or not left.connected)
        left.publish(LEFT, topics.HEALTH, Messages.health(1))
        await until(lambda: left.account.waiting == 0 and left.connected)
        assert len(script.greetings) == 2 * 3
        assert script.received[-1].topic == f"{LEFT}/health"
    assert caplog.text.count("ends the connection upon") == 1


def ending(largest: LargestMessages, at_s: float, *, at_once: bool = True) -> object:
    largest.connected(at_once=at_once)
    largest.sent([Packet("small", bytes(300), pack())], at_s, awaited=True)
    largest.acknowledged()
    largest.sent([Packet("large", bytes(40_000), pack())], at_s)
    return largest.ended(at_s + 0.1)


def test_twice_in_a_row_is_believed_and_forgotten_after_a_while() -> None:
    largest = LargestMessages()
    assert ending(largest, 0.0) is None
    assert ending(largest, 1.0) == ("large", 40_000)
    assert largest.bytes_max(2.0) == 39_999
    assert largest.bytes_max(1.2 + EXPIRY_S) > 1e6


@pytest.mark.parametrize(
    "settings",
    [("retain_available false",), ("max_qos 0",), ("retain_available false", "max_qos 0")],
    ids=["no retained messages", "QoS 0 alone", "neither"],
)
async def test_a_broker_that_would_refuse_the_last_will_is_served_without(
    tmp_path: Path, settings: tuple[str, ...]
) -> None:
    first, *others = ("allow_anonymous true", *settings)
    broker = Mosquitto(tmp_path, first, *others)
    await broker.start()
    async with publishing(broker.url) as left:
        await until(lambda: left.connected)
        left.publish(LEFT, topics.STATE_LINK, Messages.state("online", "plugged in"))
        await until(lambda: left.account.waiting == 0)
        assert left.account.dropped == {}
    await broker.kill()
