"""Connecting: version, socket options, and one line of log per change, whatever is wrong with the broker."""

import asyncio
import socket

import aiomqtt
import pytest
from brokers import Mosquitto
from mqtt_helpers import QUICK, publishing, said, scripted_broker, until

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import MQTT_5, BrokerConnection
from resonator_daemon.mqtt.codec import Incoming


async def test_the_version_is_asked_for_without_name_password_and_will_which_old_brokers_misread() -> None:
    async with scripted_broker() as (url, script), publishing(url.replace("//", "//robot:sesame@")) as left:
        await until(lambda: left.connected)
        probe, connect = (greeting.removeprefix(b"\x00\x04MQTT\x05") for greeting in script.greetings)
    assert probe[0] == 0b0000_0010  # flags: clean start only
    assert connect[0] == 0b1110_1110  # name, password, will: retained, QoS 1, present; clean start
    assert b"robot\x00\x06sesame" in connect
    assert b"resonator/left/state/daemon" in connect


async def test_a_broker_that_does_not_answer_is_given_up_and_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    async with scripted_broker() as (url, script), publishing(url, times=QUICK) as left:
        script.mute = True
        await until(lambda: len(script.connections) > 2)
        assert said(caplog) == [
            "it accepts connections and does not answer as an MQTT broker; see mqtt.url; trying again"
        ]
        script.mute = False
        await until(lambda: left.connected)


async def test_a_cancelled_attempt_closes_its_socket_and_logs_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        connection = BrokerConnection(Mqtt(url=f"mqtt://127.0.0.1:{silent.getsockname()[1]}"), MQTT_5)
        connecting = asyncio.create_task(connection.connect())
        taken, _ = await asyncio.to_thread(silent.accept)
        with taken:
            assert await asyncio.to_thread(taken.recv, 1000)  # CONNECT
            connecting.cancel()
            await asyncio.wait([connecting])
            assert await asyncio.to_thread(taken.recv, 1000) == b""
    assert connecting.cancelled()
    assert not connection.connected
    assert caplog.records == []


async def test_with_a_pause_messages_are_read_together_in_order_and_all(mosquitto: Mosquitto) -> None:
    broker, found, turns, count = Mqtt(url=mosquitto.url), list[int](), set[object](), 600
    turn: list[object] = []  # one object for each turn of the event loop in which messages are read

    def receive(message: Incoming) -> None:
        if not turn:
            turn.append(object())
            asyncio.get_running_loop().call_soon(turn.clear)
        turns.add(turn[0])
        found.append(int.from_bytes(message.payload[:2], "big"))

    connection = BrokerConnection(broker, MQTT_5, on_message=receive, read_pause_s=0.05)
    await connection.connect()
    assert await connection.subscribe("a", qos=0) is None
    async with aiomqtt.Client(broker.host, broker.port) as client:
        for number in range(count):
            await client.publish("a", number.to_bytes(2, "big") + bytes(number % 7 * 10_000))
        await until(lambda: len(found) == count)
        assert found == list(range(count))
        assert len(turns) < count // 4
        await client.publish("a", bytes(2))  # after a time without messages
        await until(lambda: len(found) > count)
    await connection.disconnect()
    assert not connection.connected
