"""`resonatord bridge home-assistant`: one retained message for each plate, whose sensors read the plate's topics."""

import asyncio
import hashlib
import json
import logging
import re
import signal
from typing import Any, Final

from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.base.host.text import printable
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import BrokerConnection
from resonator_daemon.mqtt.codec import Incoming, decode
from resonator_daemon.mqtt.payloads import Condition, CounterType, Info
from resonator_daemon.mqtt.reconnection import keep_connected
from resonator_daemon.mqtt.subscriber import EVERY_PLATE
from resonator_daemon.mqtt.topics import (
    CONTACTS,
    HEALTH,
    INFO,
    STATE_DAEMON,
    STATE_LINK,
    STATE_SENSOR,
    Topic,
    full_topic,
    split_topic,
)

_UNFIT: Final = re.compile(r"[^A-Za-z0-9_-]")  # for a level of a discovery topic
_FORCE: Final = (
    "{% set forces = value_json.contacts | map(attribute='force_newton.2') | list %}"
    "{{ none if none in forces or (not forces and value_json.status != 'ok') else (forces + [0.0]) | max | round(2) }}"
)
_WHY: Final = "{{ {'reason_code': value_json.reason_code, 'reason': value_json.reason} | tojson }}"
_AVAILABLE: Final = (
    f"{{{{ '{Condition.ONLINE}' if value_json.state == '{Condition.ONLINE}' else '{Condition.OFFLINE}' }}}}"
)


_WRITABLE_S: Final = 0.05  # between two looks whether the connection takes a message

log = logging.getLogger(__name__)


async def serve(broker: Mqtt, discovery_prefix: str, *, plate: str | None = None) -> None:
    """List plates below the broker's prefix in Home Assistant until SIGINT, SIGTERM or SIGHUP.

    A plate whose retained `info` is cleared is no longer listed.

    Parameters
    ----------
    broker
        Where plates publish, and Home Assistant subscribes; it may come and go.
    discovery_prefix
        Of Home Assistant's MQTT integration.
    plate
        The only one; None: all of them.
    """
    loop = asyncio.get_running_loop()
    closing: asyncio.Future[None] = loop.create_future()
    received: asyncio.Queue[Incoming] = asyncio.Queue()

    def make_connection(version: MQTTProtocolVersion) -> BrokerConnection:
        return BrokerConnection(broker, version, on_message=received.put_nowait)

    async def publish(connection: BrokerConnection) -> None:
        connection.subscribe(full_topic(broker.prefix, plate or EVERY_PLATE, INFO.path))
        while True:
            topic, payload = discovery(broker.prefix, discovery_prefix, await received.get())
            while not connection.writable:  # noqa: ASYNC110 - rare: these messages are few
                await asyncio.sleep(_WRITABLE_S)
            if topic:
                connection.send(topic, payload, qos=1, retain=True)

    def close(_: signal.Signals) -> None:
        if not closing.done():
            closing.set_result(None)

    with on_signals(close):
        await keep_connected(broker, make_connection, publish, closing)


def discovery(prefix: str, discovery_prefix: str, message: Incoming) -> tuple[str, bytes]:
    """Return topic and payload of the retained message of a plate, as Home Assistant from 2024.11 on reads it.

    Both are empty if the plate's `info` cannot be read; the payload is, if it was cleared.
    """
    name, _ = split_topic(prefix, message.topic)
    topic = f"{discovery_prefix}/device/{_level(prefix)}/{_level(name)}/config"
    if not message.payload:
        return topic, b""
    try:
        info = decode(Info, message.payload)
    except (ValueError, RecursionError):
        log.warning("%s: message cannot be read", printable(message.topic))
        return "", b""
    return topic, json.dumps(_message(f"{prefix}/{name}", f"{_level(prefix)}_{_level(name)}", name, info)).encode()


def _message(base: str, identifier: str, name: str, info: Info) -> dict[str, Any]:
    available = {"availability_topic": f"{base}/{STATE_DAEMON.path}", "availability_template": _AVAILABLE}
    sensors = {
        "daemon": _state(base, STATE_DAEMON, "Daemon"),
        "link": _state(base, STATE_LINK, "Link") | available,
        "sensor": _state(base, STATE_SENSOR, "Sensor") | available,
        "lost": _health(base, "Losses", "{{ value_json.lost.values() | sum }}", state_class="total_increasing")
        | available,
        "frame_rate": _health(base, "Frame rate", "{{ value_json.frame_rate_hz | round(1) }}", unit_of_measurement="Hz")
        | available,
    }
    if CONTACTS.path in info.rates_hz or info.skin is not None:  # a decoder elsewhere publishes those of a skin
        sensors["force"] = {
            "name": "Force",
            "state_topic": f"{base}/{CONTACTS.slow_path}",
            "value_template": _FORCE,
            "unit_of_measurement": "N",
            "state_class": "measurement",
            "suggested_display_precision": 2,
            **available,
        }
    if info.skin is None and info.counter == CounterType.CHANNELISED:  # others do not show their temperature
        sensors["temperature"] = {
            "name": "Temperature above reference",  # without device class: a difference, not to be converted
            "state_topic": f"{base}/{STATE_SENSOR.path}",
            "value_template": "{{ value_json.compensation.plate_kelvin | round(2) "
            "if value_json.compensation and value_json.compensation.plate_kelvin is number else none }}",
            "unit_of_measurement": "K",
            "state_class": "measurement",
            **available,
        }
    device = {
        "identifiers": [identifier],
        "name": name,
        "model": info.product,
        "model_id": info.plate,
        "sw_version": info.firmware,
        "serial_number": info.serial_number,
    }
    return {
        "device": {key: value for key, value in device.items() if value},
        "origin": {"name": "resonatord", "sw_version": info.daemon_version},
        "components": {
            key: {"platform": "sensor", "unique_id": f"{identifier}_{key}", **sensor} for key, sensor in sensors.items()
        },
    }


def _state(base: str, topic: Topic[Any], name: str) -> dict[str, Any]:
    return {
        "name": name,
        "state_topic": f"{base}/{topic.path}",
        "value_template": "{{ value_json.state }}",
        "device_class": "enum",
        "options": list(Condition),
        "json_attributes_topic": f"{base}/{topic.path}",
        "json_attributes_template": _WHY,
        "entity_category": "diagnostic",
    }


def _health(base: str, name: str, template: str, **further: object) -> dict[str, Any]:
    topic = {"name": name, "state_topic": f"{base}/{HEALTH.path}", "value_template": template}
    return {"state_class": "measurement", "entity_category": "diagnostic"} | topic | further


def _level(text: str) -> str:
    """Return a text as one level: other signs become `_`, followed by a hash so that two texts never agree."""
    fit = _UNFIT.sub("_", text)
    return fit if fit == text else f"{fit}_{hashlib.sha256(text.encode()).hexdigest()[:8]}"
