"""`resonatord.subscribe` and `resonatord.command` at brokers, with as much of a daemon as they need."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import aclosing

import pytest
import resonatord
from brokers import Mosquitto
from commanded import Commanded, commanded, state
from example_messages import example

from resonator_daemon.mqtt import requests
from resonator_daemon.mqtt.commands import CommandRefusedError
from resonator_daemon.mqtt.topics import FORCES, STATE_DAEMON, STATE_LINK
from resonator_daemon.mqtt.verbs import Mark, Ping, Pong

NOWHERE = "mqtt://127.0.0.1:9"


def refuse(_: Mark) -> None:
    raise CommandRefusedError("not_recording", "nothing is being recorded")


def pong(_: Ping) -> Pong:
    return Pong(t_ns=1, daemon_boot_id="first", uptime_s=2.5)


@pytest.fixture
async def left(broker: Mosquitto) -> AsyncIterator[Commanded]:
    handlers = {"ping": pong, "mark": refuse}
    async with (
        commanded(broker.url, handlers, ["mark"]) as left,
        commanded(broker.url, handlers, name="right") as right,
    ):
        for daemon in (left, right):
            daemon.publisher.publish(daemon.base, STATE_DAEMON, state("online", "measuring"))
            daemon.publisher.publish(daemon.base, STATE_LINK, state("online", "frames come"))
        yield left


async def test_messages_of_one_plate_are_objects(broker: Mosquitto, left: Commanded) -> None:
    messages = resonatord.subscribe(broker.url, "left", ["forces", "state/link"])
    async with asyncio.timeout(30), aclosing(messages):
        plate, path, message = await anext(messages)
        assert (plate, path, message.state) == ("left", "state/link", "online")
        assert isinstance(message, resonatord.State)
        left.publisher.publish(left.base, FORCES, example(resonatord.Forces, seq=3))
        received = await anext(messages)
    assert isinstance(received.message, resonatord.Forces)
    assert received.message.seq == 3
    async with asyncio.timeout(30), aclosing(resonatord.subscribe(broker.url, topics="state/daemon")) as messages:
        assert {(await anext(messages)).plate for _ in range(2)} == {"left", "right"}


async def test_a_command_is_answered_or_refused(broker: Mosquitto, left: Commanded) -> None:
    answer = await resonatord.command(broker.url, "left", "ping")
    assert (type(answer), answer.uptime_s) == (Pong, 2.5)
    codes = []
    for arguments in ({"text": "begun"}, {"txt": "begun"}):
        with pytest.raises(resonatord.RefusedError) as caught:
            await resonatord.command(resonatord.Mqtt(url=broker.url), "left", "mark", **arguments)
        codes.append(caught.value.code)
    assert codes == ["not_recording", "payload"]


async def test_unreachable_parts_have_codes(
    broker: Mosquitto, left: Commanded, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(requests, "LOOK_S", 0.3)
    codes = []
    for url, plate in ((NOWHERE, "left"), (broker.url, "nobody"), (broker.url, "+"), ("127.0.0.1", "left")):
        for attempt in (anext(resonatord.subscribe(url, plate)), resonatord.command(url, plate, "ping")):
            with pytest.raises(resonatord.UserError) as caught:
                await attempt
            codes.append(caught.value.code)
    assert codes == [code for code in ("no_broker", "no_daemon", "usage", "usage") for _ in range(2)]
    with pytest.raises(resonatord.UserError, match="forces"):
        await anext(resonatord.subscribe(broker.url, topics="force"))
