"""Removal of a plate from discovery: which topics are cleared, when it is refused, and what a broker may deny."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import urlsplit

import aiomqtt
import pytest
from brokers import Amqtt, Mosquitto
from mqtt_helpers import LEFT, Messages, password_line, publishing, until
from observer import Observer, observe

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import topics
from resonator_daemon.mqtt.removal import NoPlateError, NotOfflineError, remove_plate
from resonator_daemon.mqtt.requests import DeniedError

ONLINE = Messages.state("online", "measuring")
OFFLINE = b'{"state": "offline", "reason": "stopped"}'


@asynccontextmanager
async def client(url: str) -> AsyncIterator[aiomqtt.Client]:
    at = urlsplit(url)
    async with aiomqtt.Client(
        at.hostname or "", at.port or 1883, username=at.username, password=at.password
    ) as connected:
        yield connected


async def retain(url: str, messages: dict[str, bytes]) -> None:
    async with client(url) as other:
        for topic, payload in messages.items():
            await other.publish(topic, payload, qos=1, retain=True)


async def retained(url: str) -> set[str]:
    """Return the retained topics: those that arrive before an own message does."""

    def marked(heard: Observer) -> bool:
        return bool(heard.raw("end/of/retained"))

    async with observe(url) as heard:
        await heard.client.publish("end/of/retained", b"1", qos=1)
        await heard.until(lambda: marked(heard))
        return {message.topic.value for message in heard.messages if message.retain}


async def test_a_plate_that_stopped_is_removed_with_everything_that_is_retained(broker: Mosquitto | Amqtt) -> None:
    async with publishing(broker.url) as left:
        for topic in (topics.STATE_LINK, topics.STATE_SENSOR):
            left.publish(LEFT, topic, ONLINE)
        left.retain(f"{LEFT}/schema", b"{}", "application/json")
        await until(lambda: left.connected)
    others = {"resonator/left-index/info": b"{}", "resonator/right/state/daemon": OFFLINE, "elsewhere/left/info": b"{}"}
    await retain(broker.url, {f"{LEFT}/of/another/client": b"junk", **others})
    removed = await remove_plate(Mqtt(url=broker.url), "left")
    assert set(removed) == {"state/daemon", "state/link", "state/sensor", "schema", "of/another/client"}
    assert removed[-1] == "state/daemon"
    assert await retained(broker.url) == others.keys()
    with pytest.raises(NoPlateError):
        await remove_plate(Mqtt(url=broker.url), "left")


async def test_a_running_plate_is_not_removed(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto.url) as left:
        left.publish(LEFT, topics.STATE_DAEMON, ONLINE)
        left.publish(LEFT, topics.STATE_LINK, ONLINE)
        await until(lambda: left.connected and left.account.waiting == 0)
        with pytest.raises(NotOfflineError):
            await remove_plate(Mqtt(url=mosquitto.url), "left")
        assert await retained(mosquitto.url) == {f"{LEFT}/state/daemon", f"{LEFT}/state/link"}
        with pytest.raises(NotOfflineError):  # it restores them
            await remove_plate(Mqtt(url=mosquitto.url), "left", force=True)
        async with observe(mosquitto.url) as late:
            for path in ("state/daemon", "state/link"):
                await late.until_last(f"{LEFT}/{path}", state="online")


@pytest.mark.parametrize("state", [b'{"state": "online"}', b"junk", b"[]", b'{"state": ' * 5000])
async def test_a_state_that_no_daemon_corrects_any_more_takes_force(mosquitto: Mosquitto, state: bytes) -> None:
    """As after the last will was lost with its broker."""
    await retain(mosquitto.url, {f"{LEFT}/state/daemon": state, f"{LEFT}/info": b"{}"})
    with pytest.raises(NotOfflineError):
        await remove_plate(Mqtt(url=mosquitto.url), "left")
    assert await retained(mosquitto.url) == {f"{LEFT}/state/daemon", f"{LEFT}/info"}
    assert await remove_plate(Mqtt(url=mosquitto.url), "left", force=True) == ("info", "state/daemon")
    assert await retained(mosquitto.url) == set()


async def test_what_an_interrupted_removal_left_is_removed_without_force(mosquitto: Mosquitto) -> None:
    await retain(mosquitto.url, {f"{LEFT}/schema": b"{}"})
    assert await remove_plate(Mqtt(url=mosquitto.url), "left") == ("schema",)


async def test_streams_meanwhile_are_no_retained_topics(mosquitto: Mosquitto) -> None:
    await retain(mosquitto.url, {f"{LEFT}/state/daemon": OFFLINE})
    async with client(mosquitto.url) as other:

        async def stream() -> None:
            while True:
                await other.publish(f"{LEFT}/forces", b"{}")

        streaming = asyncio.create_task(stream())
        assert await remove_plate(Mqtt(url=mosquitto.url), "left") == ("state/daemon",)
        streaming.cancel()


async def test_who_may_not_write_is_denied(tmp_path: Path) -> None:
    (tmp_path / "passwords").write_text(password_line("boss", "open sesame") + "\n")
    (tmp_path / "rules").write_text("topic read resonator/#\nuser boss\ntopic readwrite #\n")
    for path in ("passwords", "rules"):
        (tmp_path / path).chmod(0o600)
    files = f"password_file {tmp_path / 'passwords'}", f"acl_file {tmp_path / 'rules'}"
    broker = Mosquitto(tmp_path, "allow_anonymous true", *files)
    await broker.start()
    try:
        boss = broker.url.replace("mqtt://", "mqtt://boss:open%20sesame@")
        async with aiomqtt.Client(
            "127.0.0.1", Mqtt(url=broker.url).port, username="boss", password="open sesame"
        ) as other:
            await other.publish(f"{LEFT}/state/daemon", OFFLINE, qos=1, retain=True)
        with pytest.raises(DeniedError):
            await remove_plate(Mqtt(url=broker.url), "left")
        assert await remove_plate(Mqtt(url=boss), "left") == ("state/daemon",)
    finally:
        await broker.kill()
