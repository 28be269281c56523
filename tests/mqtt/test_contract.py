"""Every topic as a plain subscriber gets it: from Mosquitto with MQTT 5 and with 3.1.1, and from amqtt."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import aiomqtt
import pytest
from brokers import Amqtt, Mosquitto
from mqtt_helpers import LEFT, Messages, publishing, until
from relay import relay

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import asyncapi
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.publisher import Publisher
from resonator_daemon.mqtt.topics import DECODER_HEALTH, DECODER_STATE, JSON, SCHEMA_PATH, TOPICS

CBOR_TOPICS = {"signals", "signals/5hz", "decoded", "decoded/5hz"}
COPIES = {
    "forces": "forces/20hz",
    "contacts": "contacts/20hz",
    "signals": "signals/5hz",
    "decoded": "decoded/5hz",
    "decoded/summary": "decoded/summary/20hz",
}
ACKNOWLEDGED = {"state/daemon", "state/link", "state/sensor", "info", "schema", "contacts/event"}
RETAINED = ACKNOWLEDGED - {"contacts/event"}
EXPIRY_S = {"health": 60, "tones": 10} | {path: 10 for copied in COPIES.items() for path in copied}
DECODER = "resonator/decoder/host-1"


class Way(NamedTuple):
    """How messages go to a broker, and by which version a subscriber hears of them."""

    url: str
    publisher_url: str
    publisher: str
    subscriber: aiomqtt.ProtocolVersion
    tells_qos: bool  # amqtt hands everything on with the QoS that the subscriber asked for


@pytest.fixture(params=["mosquitto, 5", "mosquitto, 3.1.1", "amqtt, 3.1.1"])
async def way(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Way]:
    name, version = request.param.split(", ")
    newest = aiomqtt.ProtocolVersion.V5 if name == "mosquitto" else aiomqtt.ProtocolVersion.V311
    async with Mosquitto(tmp_path) if name == "mosquitto" else Amqtt() as broker:
        made = Way(broker.url, broker.url, version, newest, tells_qos=name == "mosquitto")
        if version == "3.1.1" and name == "mosquitto":  # which has no setting to refuse MQTT 5
            async with relay(broker.url, refuse_mqtt_5=True) as before:
                yield made._replace(publisher_url=before.url)
        else:
            yield made


@asynccontextmanager
async def subscribed(way: Way) -> AsyncIterator[dict[str, Any]]:
    """Messages by topic, the last of each."""
    heard: dict[str, Any] = {}

    async def listen(client: aiomqtt.Client) -> None:
        async for message in client.messages:
            heard[message.topic.value] = message

    async with aiomqtt.Client("127.0.0.1", Mqtt(url=way.url).port, protocol=way.subscriber) as client:
        await client.subscribe("resonator/#", qos=1)
        listening = asyncio.create_task(listen(client))
        try:
            yield heard
        finally:
            listening.cancel()
            await asyncio.wait([listening])


def publish_all(publisher: Publisher) -> dict[str, bytes]:
    """Publish a message on every topic; return what must arrive."""
    for path, message in Messages.by_path().items():
        publisher.publish(LEFT, TOPICS[path], message)
    publisher.retain(f"{LEFT}/{SCHEMA_PATH}", asyncapi.encoded(), JSON)
    publisher.publish(DECODER, DECODER_STATE, Messages.decoder_state("online"))
    publisher.publish(DECODER, DECODER_HEALTH, Messages.decoder_health(1))
    payloads = {path: encode(message) for path, message in Messages.by_path().items()}
    copies = {copy: payloads[path] for path, copy in COPIES.items()}
    expected = {f"{LEFT}/{path}": payload for path, payload in (payloads | copies).items()}
    return expected | {
        f"{LEFT}/schema": asyncapi.encoded(),
        f"{DECODER}/state": encode(Messages.decoder_state("online")),
        f"{DECODER}/health": encode(Messages.decoder_health(1)),
    }


async def test_payload_quality_of_service_and_properties_of_each_topic(way: Way) -> None:
    async with subscribed(way) as heard, publishing(way.publisher_url) as left:
        await until(lambda: left.connected)
        expected = publish_all(left)
        await until(lambda: heard.keys() >= expected.keys())
        assert left.protocol == way.publisher
        assert heard.keys() == expected.keys()
        for topic, payload in expected.items():
            path = topic.removeprefix(f"{LEFT}/")
            assert heard[topic].payload == payload, topic
            acknowledged = path in ACKNOWLEDGED or topic == f"{DECODER}/state"
            assert not way.tells_qos or heard[topic].qos == acknowledged, topic
            told = heard[topic].properties.json() if heard[topic].properties is not None else {}
            if way.publisher != "5":
                assert told == {}, topic
                continue
            expiry_s = {f"{DECODER}/state": 3600, f"{DECODER}/health": 60}.get(topic, EXPIRY_S.get(path))
            left_s = told.pop("MessageExpiryInterval", None)  # the broker takes off what has gone by
            assert (left_s is None) == (expiry_s is None), topic
            assert expiry_s is None or expiry_s - 5 <= left_s <= expiry_s, topic
            assert told.pop("UserProperty") == [("schema_version", "2.1")], topic
            json_type = {"ContentType": "application/json", "PayloadFormatIndicator": 1}
            assert told == ({"ContentType": "application/cbor"} if path in CBOR_TOPICS else json_type), topic


async def test_a_late_subscriber_has_what_is_retained_and_nothing_else(way: Way) -> None:
    async with publishing(way.publisher_url) as left:
        await until(lambda: left.connected)
        async with subscribed(way) as in_time:
            expected = publish_all(left)
            await until(lambda: in_time.keys() >= expected.keys())
        async with subscribed(way) as heard:
            retained = {f"{LEFT}/{path}" for path in RETAINED} | {f"{DECODER}/state"}
            await until(lambda: heard.keys() >= retained)
            left.publish(LEFT, TOPICS["health"], Messages.health(9))  # comes after all that the broker kept
            await until(lambda: f"{LEFT}/health" in heard)
            assert heard.keys() == retained | {f"{LEFT}/health"}
            assert all(heard[topic].retain and heard[topic].payload == expected[topic] for topic in retained)
