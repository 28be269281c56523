"""Commands over brokers, from a request to its answer."""

import asyncio
import json

import aiomqtt
import pytest
from brokers import Amqtt, Mosquitto, free_port
from commanded import commanded
from mqtt_helpers import scripted_broker
from observer import observe
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import requests
from resonator_daemon.mqtt.commands import Handler
from resonator_daemon.mqtt.requests import BrokerUnreachableError, DeniedError, NoAnswerError, request
from resonator_daemon.mqtt.verbs import Mark, MarkAnswer

BASE = "resonator/left"
MARK = b'{"text": "warm"}'


def mark(request: Mark) -> MarkAnswer:
    return MarkAnswer(t_ns=len(request.text))


HANDLERS: dict[str, Handler] = {"mark": mark}
ALLOWED = ("mark",)


async def test_response_topic_and_correlation_of_mqtt_5_are_honoured(mosquitto: Mosquitto) -> None:
    host, port = mosquitto.url.removeprefix("mqtt://").split(":")
    async with (
        commanded(mosquitto.url, HANDLERS, ALLOWED),
        aiomqtt.Client(host, int(port), protocol=aiomqtt.ProtocolVersion.V5) as client,
    ):
        await client.subscribe("robot/answers")
        asked = Properties(PacketTypes.PUBLISH)
        asked.ResponseTopic = "robot/answers"
        asked.CorrelationData = b"\x00\xff7"
        await client.publish(f"{BASE}/cmd/mark", MARK, qos=1, properties=asked)
        async with asyncio.timeout(20):
            message = await anext(client.messages)
        assert json.loads(message.payload)["ok"] is True
        assert message.properties.CorrelationData == b"\x00\xff7"
        assert message.properties.ContentType == "application/json"
        assert not message.retain


async def test_answers_of_others_are_told_apart_by_their_id(broker: Mosquitto | Amqtt) -> None:
    async with commanded(broker.url, HANDLERS, ALLOWED):
        texts = ["a" * length for length in range(1, 6)]
        asked = (request(Mqtt(url=broker.url), "left", "mark", {"text": text}) for text in texts)
        answers = await asyncio.gather(*asked)
    assert [int(answer["t_ns"]) for answer in answers] == [1, 2, 3, 4, 5]


async def test_a_request_that_cannot_be_read_is_answered_all_the_same(mosquitto: Mosquitto) -> None:
    async with commanded(mosquitto.url, HANDLERS, ALLOWED):
        answer = await request(Mqtt(url=mosquitto.url), "left", "mark", {"text": "a" * 20_000})
    assert (answer["id"], answer["error"]["code"]) == (None, "payload")


async def test_the_sender_of_an_unknown_verb_receives_a_refusal(broker: Mosquitto | Amqtt) -> None:
    async with commanded(broker.url, HANDLERS, ALLOWED):
        answer = await request(Mqtt(url=broker.url), "left", "fly", {"id": "7"})
    assert (answer["verb"], answer["id"], answer["error"]["code"]) == ("unknown", "7", "unknown_verb")


async def test_nobody_there_is_said(mosquitto: Mosquitto) -> None:
    with pytest.raises(NoAnswerError, match=r"no answer to resonator/left/cmd/tare within 0\.2 s; is `resonatord run`"):
        await request(Mqtt(url=mosquitto.url), "left", "tare", {}, answer_s=0.2)
    with pytest.raises(BrokerUnreachableError, match=r"no broker at 127\.0\.0\.1"):
        await request(Mqtt(url=f"mqtt://127.0.0.1:{free_port()}"), "left", "tare", {})


async def test_a_broker_that_denies_it_is_said_at_once() -> None:
    not_authorised = 0x87
    async with scripted_broker() as (url, script):
        script.answer = lambda number: not_authorised
        with pytest.raises(DeniedError, match=r"the broker denies resonator/left/cmd/tare; see its access rules"):
            await request(Mqtt(url=url), "left", "tare", {})
        script.answer = lambda number: None
        script.subscribed = not_authorised
        with pytest.raises(DeniedError, match=r"the broker denies resonator/left/rsp/tare/[0-9a-f]{16}; see"):
            await request(Mqtt(url=url), "left", "tare", {})


async def test_only_the_daemons_word_counts_as_an_answer(mosquitto: Mosquitto) -> None:
    host, port = mosquitto.url.removeprefix("mqtt://").split(":")
    async with (
        aiomqtt.Client(host, int(port), protocol=aiomqtt.ProtocolVersion.V5) as other,
        observe(mosquitto.url, f"{BASE}/cmd/mark"),
    ):
        await other.subscribe(f"{BASE}/cmd/mark")
        asking = asyncio.create_task(request(Mqtt(url=mosquitto.url), "left", "mark", {"text": "a"}))
        async with asyncio.timeout(20):
            command = await anext(other.messages)
        topic = command.properties.ResponseTopic
        strange = (b"\xff", b"[" * 100_000, b"[]", b"{}", b'{"verb": "tare", "ok": true}')
        for payload in (*strange, b'{"verb": "mark", "ok": true}'):
            await other.publish(topic, payload, qos=1)
        async with asyncio.timeout(20):
            assert await asking == {"verb": "mark", "ok": True}


@pytest.mark.parametrize("username", [None, "left"])
@pytest.mark.parametrize("answer", [None, b"", b"HTTP/1.0 400 Bad Request\r\n\r\n"])  # None: it is silent
async def test_a_server_that_is_no_broker_is_not_taken_for_one_without_a_daemon(
    answer: bytes | None, username: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(requests, "REACH_S", 0.2)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if answer is None:
            await reader.read()  # to its end
        else:
            writer.write(answer)
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        broker = Mqtt(url=f"mqtt://127.0.0.1:{server.sockets[0].getsockname()[1]}", username=username)
        with pytest.raises(BrokerUnreachableError) as unreachable:
            await request(broker, "left", "mark", {})
    assert (unreachable.value.code, unreachable.value.exit_code) == ("no_broker", 69)
