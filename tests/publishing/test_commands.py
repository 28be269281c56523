"""Commands over MQTT: answered on the topic asked for, bounded, and refused where they make no sense."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import aiomqtt
import pytest
from brokers import Amqtt, Mosquitto, free_port
from mqtt_helpers import Messages, assert_exact, scripted_broker, until
from observer import observe
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.commands import (
    WAITING_MAX,
    CommandRefusedError,
    Commands,
    Incoming,
    Outgoing,
    Respond,
)
from resonator_daemon.publishing.publisher import ANSWERS_WAITING_MAX, Publisher
from resonator_daemon.publishing.requests import BrokerUnreachableError, NoAnswerError, request
from resonator_daemon.publishing.topics import CONTACT_EVENT

BASE = "resonator/left"


def handler(verb: str, payload: dict[str, Any], respond: Respond) -> None:
    """Say what came; refuse all but one verb."""
    if verb != "tare":
        raise CommandRefusedError("unknown_verb", f"no command is called {verb!r}", "known: tare")
    respond({"ok": True, "did": "tared", "payload": payload})


@asynccontextmanager
async def commanded(url: str) -> AsyncIterator[Publisher]:
    publisher = Publisher(Mqtt(url=url), "left", lambda reason: Messages.state("offline", reason), handler)
    running = asyncio.create_task(publisher.run())
    yield publisher
    await publisher.close()
    await running
    assert_exact(publisher)


def answers_to(*messages: Incoming) -> list[tuple[Outgoing, dict[str, Any]]]:
    """Give messages to commands without a broker; return what is sent, and what that says."""

    async def give() -> list[Outgoing]:
        sent: list[Outgoing] = []
        commands = Commands(BASE, handler, sent.append)
        for message in messages:
            commands.take(message)
        for _ in messages:
            await asyncio.sleep(0)  # one with each turn of the loop
        await asyncio.sleep(0)
        return sent

    return [(answer, json.loads(answer.payload)) for answer in asyncio.run(give())]


def incoming(
    verb: str = "tare",
    payload: bytes = b"{}",
    response_topic: str | None = None,
    *,
    retained: bool = False,
    correlation: bytes | None = None,
) -> Incoming:
    return Incoming(f"{BASE}/cmd/{verb}", payload, retained, response_topic, correlation)


async def test_a_command_is_answered(broker: Mosquitto | Amqtt) -> None:
    async with commanded(broker.url) as publisher:
        await until(lambda: publisher.connected)
        answer = await request(Mqtt(url=broker.url), "left", "tare", {"why": "warm"})
        assert answer == {"verb": "tare", "ok": True, "did": "tared", "payload": {"why": "warm"}}
        answer = await request(Mqtt(url=broker.url), "left", "explode", {})
        assert answer["ok"] is False
        assert answer["error"] == {
            "code": "unknown_verb",
            "message": "no command is called 'explode'",
            "hint": "known: tare",
        }


async def test_response_topic_and_correlation_of_mqtt_5_are_honoured(mosquitto: Mosquitto) -> None:
    host, port = mosquitto.url.removeprefix("mqtt://").split(":")
    async with (
        commanded(mosquitto.url) as publisher,
        aiomqtt.Client(host, int(port), protocol=aiomqtt.ProtocolVersion.V5) as client,
    ):
        await until(lambda: publisher.connected)
        await client.subscribe("robot/answers")
        asked = Properties(PacketTypes.PUBLISH)
        asked.ResponseTopic = "robot/answers"
        asked.CorrelationData = b"\x00\xff7"
        await client.publish(f"{BASE}/cmd/tare", b"", qos=1, properties=asked)
        async with asyncio.timeout(20):
            message = await anext(client.messages)
        assert json.loads(message.payload)["ok"] is True
        assert message.properties is not None
        assert message.properties.CorrelationData == b"\x00\xff7"


async def test_a_plain_client_finds_the_answer_below_rsp(broker: Mosquitto | Amqtt) -> None:
    host, port = broker.url.removeprefix("mqtt://").split(":")
    async with commanded(broker.url) as publisher, observe(broker.url, f"{BASE}/rsp/#") as observer:
        await until(lambda: publisher.connected)
        async with aiomqtt.Client(host, int(port)) as client:
            await client.publish(f"{BASE}/cmd/tare", b"{}", qos=1)
            await observer.until_count(f"{BASE}/rsp/tare", 1)
    assert observer.payloads(f"{BASE}/rsp/tare")[0]["did"] == "tared"


async def test_commands_are_heard_again_after_a_restart_of_the_broker(mosquitto: Mosquitto) -> None:
    async with commanded(mosquitto.url) as publisher:
        await until(lambda: publisher.connected)
        await mosquitto.kill()
        await until(lambda: not publisher.connected)
        await mosquitto.start()
        await until(lambda: publisher.connected)
        assert (await request(Mqtt(url=mosquitto.url), "left", "tare", {}))["ok"] is True


async def test_a_broker_that_denies_commands_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    not_authorised = 0x87

    def warnings() -> list[str]:
        return [record.getMessage() for record in caplog.records if "commands are not heard" in record.getMessage()]

    async with scripted_broker() as (url, script), commanded(url):
        script.subscribed = not_authorised
        await until(lambda: bool(warnings()))
        before = len(script.greetings)
        script.hang_up()
        await until(lambda: len(script.greetings) > before + 1)  # the probe for MQTT 5, and the publisher
    assert warnings() == ["broker denies resonator/left/cmd/+ (Not authorized): commands are not heard"]


async def test_nobody_there_is_said(mosquitto: Mosquitto) -> None:
    with pytest.raises(NoAnswerError, match=r"no answer to resonator/left/cmd/tare within 0\.2 s; is `resonatord run`"):
        await request(Mqtt(url=mosquitto.url), "left", "tare", {}, answer_s=0.2)
    with pytest.raises(BrokerUnreachableError, match=r"no broker at 127\.0\.0\.1"):
        await request(Mqtt(url=f"mqtt://127.0.0.1:{free_port()}"), "left", "tare", {})


@pytest.mark.parametrize(
    "payload",
    [b"\xff\x00", b"[1]", b"{", b"7", b"null", b"[" * 10_000, b'{"a": ' + b"1" * 5000 + b"}", b"{}" + b" " * 20_000],
    ids=["binary", "list", "broken", "number", "null", "deep", "huge number", "long"],
)
def test_hostile_payloads_are_refused(payload: bytes) -> None:
    ((answer, said),) = answers_to(incoming(payload=payload))
    assert answer.topic == f"{BASE}/rsp/tare"
    assert said["ok"] is False
    assert said["error"]["code"] == "payload"
    assert len(answer.payload) < 1000


@pytest.mark.parametrize(
    "topic",
    [
        f"{BASE}/state/daemon",
        "resonator/right/cmd/tare",
        "a/#",
        "a/+/b",
        "$SYS/broker",
        "",
        "a\x00b",
        "a" * 70_000,
        "\ud800",
    ],
)
def test_answers_do_not_go_where_a_daemons_word_is_believed(topic: str) -> None:
    ((answer, said),) = answers_to(incoming(response_topic=topic))
    assert answer.topic == f"{BASE}/rsp/tare"
    assert said["error"]["code"] == "response_topic"


def test_answers_go_elsewhere_and_below_the_own_rsp() -> None:
    for topic in ("robot/answers", f"{BASE}/rsp/tare/17"):
        ((answer, said),) = answers_to(incoming(response_topic=topic, correlation=b"17"))
        assert (answer.topic, answer.correlation) == (topic, b"17")
        assert said["ok"] is True


def test_a_retained_command_is_nobodys() -> None:
    assert answers_to(incoming(retained=True)) == []


def test_a_flood_is_bounded() -> None:
    said = [content for _, content in answers_to(*[incoming()] * (WAITING_MAX + 3))]
    assert [content["error"]["code"] for content in said[:3]] == ["busy"] * 3  # at once, before the others' turn
    assert [content["ok"] for content in said[3:]] == [True] * WAITING_MAX


async def test_a_flood_of_commands_costs_no_event(mosquitto: Mosquitto) -> None:
    async with commanded(mosquitto.url) as publisher, observe(mosquitto.url, f"{BASE}/contacts/event") as observer:
        await until(lambda: publisher.connected)
        assert publisher._commands is not None
        for number in range(1024):  # as many as may wait, and twice as many commands among them
            publisher.publish(CONTACT_EVENT, Messages.event(number))
            publisher._commands.take(incoming())
            publisher._commands.take(incoming())
        await observer.until_count(f"{BASE}/contacts/event", 1024)
        await until(lambda: publisher.account.waiting == 0)
        account = publisher.account
    assert account.made == account.acknowledged + account.dropped
    assert account.dropped >= 2048 - WAITING_MAX - ANSWERS_WAITING_MAX  # answers, all of them


def test_a_strange_verb_does_not_get_into_topics() -> None:
    ((answer, said),) = answers_to(incoming(verb="x" * 200))
    assert answer.topic == f"{BASE}/rsp/unknown"
    assert said["error"]["code"] == "unknown_verb"
