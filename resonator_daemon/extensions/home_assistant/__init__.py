"""Discovery message of Home Assistant: one device per plate, with sensors that read the plate's topics."""

import hashlib
import json
import re
from typing import Any, Final

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.payloads import Condition, CounterType, Info
from resonator_daemon.mqtt.topics import CONTACTS, HEALTH, STATE_DAEMON, STATE_LINK, STATE_SENSOR, Topic

_UNFIT: Final = re.compile(r"[^A-Za-z0-9_-]")  # for a level of a discovery topic
_FORCE: Final = (
    "{% set forces = value_json.contacts | map(attribute='force_newton.2') | list %}"
    "{{ none if none in forces or (not forces and value_json.status != 'ok') else (forces + [0.0]) | max | round(2) }}"
)
_WHY: Final = "{{ {'reason_code': value_json.reason_code, 'reason': value_json.reason} | tojson }}"
_AVAILABLE: Final = (
    f"{{{{ '{Condition.ONLINE}' if value_json.state == '{Condition.ONLINE}' else '{Condition.OFFLINE}' }}}}"
)


def discovery(broker: Mqtt, name: str, info: Info | None, *, contacts: bool) -> tuple[str, bytes] | None:
    """Return topic and payload of the retained message of a plate, as Home Assistant from 2024.11 on reads it.

    Parameters
    ----------
    broker
        Its `home_assistant_discovery` is the discovery prefix.
    name
        Of the plate.
    info
        Its last message. None: a plate is removed; then the topic is a filter, of any discovery prefix with one level
        where `broker` has none, and the payload is empty.
    contacts
        Whether contacts of the plate are published, by the daemon or by a decoder.
    """
    discovery_prefix, plate = broker.home_assistant_discovery, (_level(broker.prefix), _level(name))
    if info is None:
        return f"{discovery_prefix or '+'}/device/{'/'.join(plate)}/config", b""
    if discovery_prefix is None:
        return None
    message = _message(f"{broker.prefix}/{name}", "_".join(plate), name, info, contacts=contacts)
    return f"{discovery_prefix}/device/{'/'.join(plate)}/config", json.dumps(message).encode()


def _message(base: str, identifier: str, name: str, info: Info, *, contacts: bool) -> dict[str, Any]:
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
    if contacts:
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
