"""Discovery in Home Assistant: the retained message, its templates on published messages, and its end."""

import json
from typing import Any

import pytest
from brokers import Mosquitto
from decoder_bench import info
from jinja2 import Environment, StrictUndefined
from observer import Observer, observe
from scenarios import IDEAL, touch_text
from service_bench import Bench

from resonator_daemon.board.config import Mqtt
from resonator_daemon.mqtt.home_assistant import discovery_message, discovery_topic
from resonator_daemon.mqtt.payloads import Condition, CounterType
from resonator_daemon.mqtt.removal import remove_plate

TOPIC = "homeassistant/device/resonator/hand/config"
PREFIX = 'home_assistant_discovery = "homeassistant"'


def rendered(template: str, payload: Any) -> str:
    """Return what Home Assistant shows: of a template its text, where None means unknown."""
    return Environment(undefined=StrictUndefined).from_string(template).render(value_json=payload)


def values(sensors: dict[str, Any], heard: Observer) -> dict[str, str]:
    last = {name: heard.payloads(sensor["state_topic"])[-1] for name, sensor in sensors.items()}
    return {name: rendered(sensor["value_template"], last[name]) for name, sensor in sensors.items()}


async def test_a_plate_appears_shows_its_force_and_goes(bench: Bench, mosquitto: Mosquitto) -> None:
    pressed = bench.scenario(IDEAL + touch_text(0.4, 2.0, 60.0, site=7))
    async with observe(mosquitto.url) as heard:
        async with bench.measured(heard, bench.service(mqtt=(PREFIX,)), scenario=pressed):
            await heard.until(lambda: bool(heard.raw(TOPIC)) and bool(heard.raw("resonator/hand/health")))
            message = heard.payloads(TOPIC)[-1]
            sensors = message["components"]
            shown: dict[str, str] = {}

            def force_shown() -> bool:
                shown.update(values(sensors, heard))
                return shown["force"] != "None" and float(shown["force"]) == pytest.approx(2.0, abs=0.1)

            await heard.until(force_shown)  # it rises
            assert (shown["daemon"], shown["link"], shown["lost"].isdecimal()) == ("online", "online", True)
            assert set(sensors["daemon"]["options"]) == set(Condition)
        assert message["device"]["serial_number"] == "EMU-0001"
        state = await heard.until_last("resonator/hand/state/daemon", state="offline")
        assert rendered(sensors["link"]["availability_template"], state) == "offline"
        assert json.loads(rendered(sensors["daemon"]["json_attributes_template"], state))["reason_code"] == "stopped"

        async with observe(mosquitto.url, TOPIC) as late:
            await late.until(lambda: bool(late.raw(TOPIC)))
        assert (await remove_plate(Mqtt(url=mosquitto.url), "hand"))[0] == TOPIC
        await heard.until(lambda: heard.raw(TOPIC)[-1] == b"")


@pytest.mark.parametrize(
    ("status", "forces", "shown"),
    [
        ("ok", [], "0.0"),
        ("ok", [1.234, 0.5], "1.23"),
        ("possibly_more", [1.5], "1.5"),
        ("overload", [None, 0.5], "None"),
        ("no_signal", [], "None"),
    ],
)
def test_an_unknown_force_is_not_zero(status: str, forces: list[float | None], shown: str) -> None:
    force = json.loads(discovery_message("resonator", "hand", info(), contacts=True))["components"]["force"]
    payload = {"status": status, "contacts": [{"force_newton": [None, None, newton]} for newton in forces]}
    assert rendered(force["value_template"], payload) == shown


def test_only_sensors_with_a_temperature_have_one() -> None:
    def sensors(**change: Any) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(discovery_message("resonator", "hand", info(**change), contacts=False))
        return message["components"]

    force_sites = sensors(skin=None, counter=CounterType.CHANNELISED)
    for compensation, shown in (({"plate_kelvin": -1.234}, "-1.23"), ({"plate_kelvin": None}, "None"), (None, "None")):
        payload = {"compensation": compensation}
        assert rendered(force_sites["temperature"]["value_template"], payload) == shown
    assert "temperature" not in sensors() | sensors(skin=None, counter=CounterType.SINGLE_TONE)
    assert "force" not in force_sites


def test_topics_of_different_plates_differ() -> None:
    """Whatever signs their names have, in the characters that Home Assistant takes."""
    names = ("left/a", "left"), ("left_a", "left"), ("resonator", "ü"), ("resonator", "é")
    topics = [discovery_topic("homeassistant", prefix, name) for prefix, name in names]
    assert len(set(topics)) == 4
    assert all(level.isascii() and level.replace("_", "").isalnum() for topic in topics for level in topic.split("/"))
