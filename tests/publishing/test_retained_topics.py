"""What other clients do to retained topics and to the topics of commands, on Mosquitto."""

import json
import time
from pathlib import Path
from urllib.parse import urlsplit

import aiomqtt
from mqtt_helpers import LEFT, Messages, happen, make_will, publishing, received_events, until
from observer import observe
from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.publishing import topics
from resonator_daemon.publishing.mqtt_messages import Incoming
from resonator_daemon.publishing.publisher import Subscription

ONLINE = Messages.state("online", "all is well")
FORCES, HEALTH = f"{LEFT}/forces", f"{LEFT}/health"
LINK, SENSOR, SCHEMA, DAEMON = (f"{LEFT}/{path}" for path in ("state/link", "state/sensor", "schema", "state/daemon"))


def client(url: str, version: MQTTProtocolVersion = MQTTProtocolVersion.MQTTv311) -> aiomqtt.Client:
    parts = urlsplit(url)
    return aiomqtt.Client(parts.hostname or "", parts.port or 1883, protocol=aiomqtt.ProtocolVersion(version))


async def test_what_another_retains_on_streams_is_cleared_live_and_left_from_before(mosquitto, caplog) -> None:
    async with client(mosquitto.url) as other:
        await other.publish(FORCES, b"junk", qos=1, retain=True)
        async with publishing(mosquitto.url, never_retained=(FORCES, f"{FORCES}/+", HEALTH)) as left:
            await until(lambda: left.account.acknowledged == 1)
            await other.publish(FORCES, b"not retained", qos=1)
            await other.publish(f"{FORCES}/33hz", b"junk", qos=1, retain=True)
            await other.publish(HEALTH, b"junk", qos=1, retain=True)
            await until(lambda: left.account.acknowledged == 3)
        async with observe(mosquitto.url, f"{LEFT}/#") as late:
            await other.publish(f"{LEFT}/marker", b"", qos=1)  # comes after what is retained
            await late.until_count(f"{LEFT}/marker", 1)
            assert late.raw(FORCES) == late.raw(f"{FORCES}/33hz") == late.raw(HEALTH) == []
    (line,) = [record.getMessage() for record in caplog.records if FORCES in record.getMessage()]
    assert HEALTH in line


async def test_what_is_retained_on_topics_of_further_rates_is_cleared_at_first(mosquitto, tmp_path: Path) -> None:
    rates = [f"{LEFT}/{path}" for path in ("forces/5hz", "contacts/7hz", "contacts/event")]
    async with publishing("mqtt://127.0.0.1:9", spool_directory=tmp_path) as left:
        await happen(left, range(3))
    async with client(mosquitto.url) as other:
        for topic in (*rates, f"{LEFT}/else/5hz"):
            await other.publish(topic, b"junk", qos=1, retain=True)
        filters = (f"{LEFT}/forces/+", f"{LEFT}/contacts/+")
        async with publishing(mosquitto.url, spool_directory=tmp_path, cleared_at_first=filters) as left:
            await until(lambda: left.account.resent >= 2)  # no subscriber is there for the events
            async with observe(mosquitto.url, f"{LEFT}/#") as late:
                assert [event["seq"] for event in await received_events(late, 2)] == [0, 1, 2]
                await other.publish(f"{LEFT}/marker", b"", qos=1)  # comes after what is retained
                await late.until_count(f"{LEFT}/marker", 1)
                assert not any(b"junk" in late.raw(topic) for topic in rates)
                assert late.raw(f"{LEFT}/else/5hz") == [b"junk"]


async def test_retained_topics_that_another_overwrites_or_clears_are_restored(mosquitto, caplog) -> None:
    async with publishing(mosquitto.url) as left, client(mosquitto.url) as other:
        for topic in (topics.STATE_LINK, topics.STATE_DAEMON):
            left.publish(LEFT, topic, ONLINE)
        left.retain(SCHEMA, b"{}", "application/json")
        await until(lambda: left.connected)
        left.publish(LEFT, topics.STATE_SENSOR, ONLINE)  # after the connection
        await until(lambda: left.account.waiting == 0)
        before = left.account.republished
        await other.publish(LINK, b"junk", qos=1, retain=True)
        await other.publish(SENSOR, b"", qos=1, retain=True)
        await other.publish(DAEMON, make_will().payload, qos=1, retain=True)  # as a broker that ends
        await other.publish(SCHEMA, b"", qos=1, retain=True)
        await until(lambda: left.account.republished == before + 4 and left.account.waiting == 0)
        async with observe(mosquitto.url, f"{LEFT}/#") as late:
            for topic in (LINK, SENSOR, DAEMON):
                await late.until_last(topic, state="online")
            assert await late.until_count(SCHEMA, 1) == [b"{}"]
    (line,) = [record.getMessage() for record in caplog.records if LINK in record.getMessage()]
    assert (SENSOR in line, SCHEMA in line, DAEMON in line) == (True, True, False)


async def test_a_flood_on_a_retained_topic_draws_a_message_a_second(mosquitto, caplog) -> None:
    async with publishing(mosquitto.url) as left, client(mosquitto.url) as other:
        left.publish(LEFT, topics.STATE_LINK, ONLINE)
        await until(lambda: left.connected and left.account.waiting == 0)
        before, begun_s = left.account.republished, time.monotonic()
        for number in range(200):
            await other.publish(LINK, b"junk %d" % number, qos=1, retain=True)
        async with observe(mosquitto.url, LINK) as late:
            await late.until(lambda: bool(late.raw(LINK)) and late.raw(LINK)[-1][:1] == b"{")
        took_s = time.monotonic() - begun_s
        assert 1 <= left.account.republished - before <= 2 + took_s
    assert len([record for record in caplog.records if LINK in record.getMessage()]) == 1


async def test_own_messages_that_come_back_are_not_restored(broker) -> None:
    """As those on a topic that is subscribed to for another reason."""
    subscription = Subscription(LINK, 1, lambda message: None)
    async with observe(broker.url, LINK) as observer, publishing(broker.url, subscriptions=(subscription,)) as left:
        await until(lambda: left.connected)
        for number in range(4):
            left.publish(LEFT, topics.STATE_LINK, Messages.state("online", str(number)))
            await observer.until_last(LINK, reason=str(number))
        assert left.account.republished == 0


async def test_a_retained_command_is_marked_also_when_it_arrives_live(mosquitto) -> None:
    heard: list[Incoming] = []
    subscription = Subscription(f"{LEFT}/cmd/+", 1, heard.append, retain_as_published=True)
    async with publishing(mosquitto.url, subscriptions=(subscription,)) as left, client(mosquitto.url) as other:
        await until(lambda: left.connected)
        await other.publish(f"{LEFT}/cmd/tare", json.dumps({}), qos=1, retain=True)
        await other.publish(f"{LEFT}/cmd/tare", b"", qos=1, retain=True)
        await other.publish(f"{LEFT}/cmd/ping", b"{}", qos=1)
        await until(lambda: len(heard) >= 3)
    assert [message.retained for message in heard] == [True, True, False]
