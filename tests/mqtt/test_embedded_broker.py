"""The embedded broker: a port of its own, no noise, and one clear sentence where it is not installed."""

import asyncio
import logging
import sys
from contextlib import AsyncExitStack

import aiomqtt
import pytest
from mqtt_helpers import until

from resonator_daemon.base.errors import UserError
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.embedded_broker import embedded_broker


async def test_it_is_quiet_and_stops_at_once_with_clients_connected(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    async with AsyncExitStack() as stack:
        url = await stack.enter_async_context(embedded_broker())
        client = aiomqtt.Client("127.0.0.1", Mqtt(url=url).port)
        await client.__aenter__()
        await client.publish("a", b"1", qos=1)
        async with asyncio.timeout(1):
            await stack.aclose()
    await until(lambda: client._disconnected.done())
    assert client._disconnected.exception() is not None
    assert [record for record in caplog.records if record.name.startswith(("amqtt", "transitions"))] == []
    with pytest.raises(aiomqtt.MqttError, match="refused"):
        await aiomqtt.Client("127.0.0.1", Mqtt(url=url).port).__aenter__()


async def test_what_to_install_where_amqtt_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "amqtt.broker", None)
    with pytest.raises(UserError, match=r"python\S* -m pip install amqtt"):
        async with embedded_broker():
            pass
