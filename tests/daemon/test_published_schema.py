"""Every message of a daemon is valid by the schema that it publishes."""

import json
from pathlib import Path
from typing import Any

import cbor2
import numpy as np
from brokers import Mosquitto
from jsonschema import Draft7Validator
from observer import Observer, observe
from scenarios import touch_text
from service_bench import Bench
from system_parts import SMALL_SKIN
from test_skin_daemon import SHEARED

PRESSED = "period_s = 1.0\n" + touch_text(0.3, 1.0, 0.3, site=7)


def rows_of(payload: bytes) -> Any:
    """Read CBOR with its typed arrays as nested rows."""

    def read_tag(tag: cbor2.CBORTag, _immutable: bool = False) -> Any:
        return np.frombuffer(tag.value, "<f4") if tag.tag == 85 else tag.value[1].reshape(tag.value[0]).tolist()

    return cbor2.loads(payload, tag_hook=read_tag)


def check_all(heard: Observer, name: str) -> set[str]:
    """Check each message of a plate by the document that its daemon has published; return the paths heard."""
    (published,) = set(heard.raw(f"resonator/{name}/schema"))
    told = json.loads(published)
    validators = {}
    for channel in told["channels"].values():
        (message,) = list(channel["messages"])[:1]
        path = channel["address"].removeprefix("{prefix}/{name}/")
        reference = {"$ref": f"#/components/schemas/{message}", "components": told["components"]}
        validators[path] = Draft7Validator(reference), told["components"]["messages"][message]["contentType"]
    paths = set()
    for message in heard.heard:
        path = message.topic.value.removeprefix(f"resonator/{name}/")
        validator, content_type = validators[path]
        payload = bytes(message.payload)
        validator.validate(json.loads(payload) if content_type == "application/json" else rows_of(payload))
        paths.add(path)
    return paths


async def test_a_daemon_of_force_sites_publishes_what_the_schema_says(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    async with (
        bench.emulated(scenario=bench.scenario(PRESSED)),
        observe(mosquitto.url) as heard,
        bench.running(bench.service()),
    ):
        await heard.until_count("resonator/hand/contacts/event", 2)
        await heard.until_count("resonator/hand/health", 1)
        await heard.until_count("resonator/hand/schema", 1)
    always = {"state/daemon", "state/link", "state/sensor", "info", "schema", "health"}
    measured = {"contacts/event", "forces", "forces/20hz", "contacts", "contacts/20hz"}
    assert check_all(heard, "hand") == always | measured


async def test_a_daemon_of_a_skin_publishes_what_the_schema_says(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    plate = tmp_path / "small-skin.toml"
    plate.write_text(SMALL_SKIN)
    scenario = bench.scenario(SHEARED)
    async with (
        bench.emulated(str(plate), scenario=scenario) as emulator,
        observe(mosquitto.url) as heard,
        bench.running(bench.service(str(plate), emulator.link.address)),
    ):
        await heard.until_count("resonator/hand/contacts/event", 1)
        await heard.until_count("resonator/hand/decoded/5hz", 3)
        await heard.until_count("resonator/hand/schema", 1)
    paths = check_all(heard, "hand")
    assert paths >= {"signals", "signals/5hz", "decoded", "decoded/5hz", "decoded/summary", "decoded/summary/20hz"}
