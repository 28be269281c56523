"""Discovery in Home Assistant: the retained message, its templates on published messages, and its end."""

import json
from pathlib import Path
from typing import Any

import pytest
from brokers import Mosquitto
from decoder_bench import info
from jinja2 import Environment, StrictUndefined
from observer import Observer, observe, running_task
from scenarios import IDEAL, touch_text
from service_bench import Bench

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.extensions.home_assistant.bridge import discovery, serve
from resonator_daemon.mqtt.codec import Incoming, encode
from resonator_daemon.mqtt.payloads import Condition, CounterType, Info

TOPIC = "homeassistant/device/resonator/hand/config"


def incoming(topic: str, payload: bytes) -> Incoming:
    return Incoming(topic, payload, retained=True, response_topic=None, correlation=None)


def sensors(info: Info) -> dict[str, Any]:
    topic, payload = discovery("resonator", "homeassistant", incoming("resonator/hand/info", encode(info)))
    assert topic == TOPIC
    found: dict[str, Any] = json.loads(payload)["components"]
    return found


def rendered(template: str, payload: Any) -> str:
    """Return what Home Assistant shows: of a template its text, where None means unknown."""
    return Environment(undefined=StrictUndefined).from_string(template).render(value_json=payload)


def values(components: dict[str, Any], heard: Observer) -> dict[str, str]:
    last = {name: heard.payloads(sensor["state_topic"])[-1] for name, sensor in components.items()}
    return {name: rendered(sensor["value_template"], last[name]) for name, sensor in components.items()}


async def test_a_plate_appears_shows_its_force_and_goes(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    pressed = bench.scenario(IDEAL + touch_text(0.4, 2.0, 60.0, site=7))
    bridge = serve(Mqtt(url=mosquitto.url), "homeassistant")
    async with observe(mosquitto.url) as heard, running_task(bridge):
        async with bench.measured(heard, bench.service(), scenario=pressed):
            await heard.until(lambda: bool(heard.raw(TOPIC)) and bool(heard.raw("resonator/hand/health")))
            message = heard.payloads(TOPIC)[-1]
            components = message["components"]
            shown: dict[str, str] = {}

            def force_shown() -> bool:
                shown.update(values(components, heard))
                return shown["force"] != "None" and float(shown["force"]) == pytest.approx(2.0, abs=0.1)

            await heard.until(force_shown)  # it rises
            assert (shown["daemon"], shown["link"], shown["lost"].isdecimal()) == ("online", "online", True)
            assert set(components["daemon"]["options"]) == set(Condition)
        assert message["device"]["serial_number"] == "EMU-0001"
        state = await heard.until_last("resonator/hand/state/daemon", state="offline")
        assert rendered(components["link"]["availability_template"], state) == "offline"
        assert json.loads(rendered(components["daemon"]["json_attributes_template"], state))["reason_code"] == "stopped"

        async with observe(mosquitto.url, TOPIC) as late:
            await late.until(lambda: bool(late.raw(TOPIC)))
        await heard.client.publish("resonator/hand/info", b"", qos=1, retain=True)
        await heard.until(lambda: heard.raw(TOPIC)[-1] == b"")


def test_an_info_that_cannot_be_read_lists_nothing() -> None:
    assert discovery("resonator", "homeassistant", incoming("resonator/hand/info", b"[]")) == ("", b"")


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
    force = sensors(info())["force"]
    payload = {"status": status, "contacts": [{"force_newton": [None, None, newton]} for newton in forces]}
    assert rendered(force["value_template"], payload) == shown


def test_only_sensors_with_a_temperature_have_one() -> None:
    def found(**change: Any) -> dict[str, Any]:
        return sensors(info(**change))

    force_sites = found(skin=None, counter=CounterType.CHANNELISED)
    for compensation, shown in (({"plate_kelvin": -1.234}, "-1.23"), ({"plate_kelvin": None}, "None"), (None, "None")):
        payload = {"compensation": compensation}
        assert rendered(force_sites["temperature"]["value_template"], payload) == shown
    assert "temperature" not in found() | found(skin=None, counter=CounterType.SINGLE_TONE)
    assert "force" not in force_sites


def test_topics_of_different_plates_differ() -> None:
    """Whatever signs their names have, in the characters that Home Assistant takes."""
    names = ("left/a", "left"), ("left_a", "left"), ("resonator", "ü"), ("resonator", "é")
    topics = {
        discovery(prefix, "ha", incoming(f"{prefix}/{name}/info", b""))[0].removeprefix("ha/") for prefix, name in names
    }
    assert len(topics) == 4
    assert all(level.isascii() and level.replace("_", "").isalnum() for topic in topics for level in topic.split("/"))
