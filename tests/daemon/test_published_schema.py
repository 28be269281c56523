"""Every message of a daemon, its answers and the commands to it are valid by the schema that it publishes."""

import json
import re
from pathlib import Path
from typing import Any

from brokers import Mosquitto
from example_messages import as_rows
from jsonschema import Draft7Validator
from observer import Observer, observe
from scenarios import touch_text
from service_bench import Bench, events
from test_skin_daemon import SHEARED

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.requests import request
from resonator_daemon.publishing.verbs import VERBS

PRESSED = "period_s = 1.0\n" + touch_text(0.3, 1.0, 0.3, site=7)
HAND = "resonator/hand"
ALWAYS = {"state/daemon", "state/link", "state/sensor", "info", "schema", "health"}
COMMANDS: list[tuple[str, dict[str, Any]]] = [
    ("ping", {}),
    ("health", {"id": "a text"}),
    ("snapshot", {}),
    ("snapshot", {"topics": ["state/link", "info"]}),
    ("events", {"after_seq": 0}),
    ("events", {"daemon_boot_id": "of nobody"}),
    ("tare", {}),  # refused while the plate is touched, else not
    ("start_recording", {"label": "schema"}),
    ("mark", {"text": "here"}),
    ("stop_recording", {}),
    ("set_window", {"window_ms": 20, "step_ms": 10}),
    ("set_window", {"window_ms": 20, "step_ms": 1000}),
    ("set_rate", {"topic": "forces", "rate_hz": 50, "lease_s": 60}),
    ("identify", {}),
]


def check_all(heard: Observer) -> set[str]:
    """Check each message by the document that the daemon has published; return the paths heard."""
    document = json.loads(heard.raw(f"{HAND}/schema")[0])
    components = document["components"]

    def validator_of(references: list[dict[str, str]]) -> tuple[Draft7Validator, str]:
        names = [reference["$ref"].rpartition("/")[2] for reference in references]
        (content_type,) = {components["messages"][name]["contentType"] for name in names}
        payloads = [components["messages"][name]["payload"] for name in names]
        return Draft7Validator({"oneOf": payloads, "components": components}), content_type

    validators = {}
    for channel in document["channels"].values():
        if channel["address"] is not None:
            path = channel["address"].removeprefix("{prefix}/{name}/")
            validators[re.sub("{.*?}", "[^/]+", path)] = validator_of(list(channel["messages"].values()))
    for name, operation in document["operations"].items():
        if "reply" in operation:
            answers = validator_of(operation["reply"]["messages"])
            validators[name.replace("cmd_", "rsp/") + "/[^/]+"] = answers
    paths = set()
    for message in heard.heard:
        path = message.topic.value.removeprefix(f"{HAND}/")
        validator, content_type = next(found for pattern, found in validators.items() if re.fullmatch(pattern, path))
        payload = bytes(message.payload)
        validator.validate(json.loads(payload) if content_type == "application/json" else as_rows(payload))
        paths.add(re.sub(r"^(rsp/\w+)/.*", r"\1/+", path))
    return paths


async def test_a_daemon_of_force_sites_publishes_what_the_schema_says(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    scenario = bench.scenario(PRESSED)
    allow = tuple(verb.name for verb in VERBS.values() if verb.changes)
    async with observe(mosquitto.url) as heard:
        async with bench.measured(heard, bench.service(allow=allow), scenario=scenario):
            await heard.until(lambda: {"onset", "release"} <= {event["event"] for event in events(heard)})
            await heard.until_count(f"{HAND}/health", 1)
            for verb, payload in COMMANDS:
                await request(Mqtt(url=mosquitto.url), "hand", verb, payload)
            await heard.client.publish(f"{HAND}/cmd/ping", "{}", qos=1)  # without a response topic
            await heard.until_count(f"{HAND}/rsp/ping", 1)
        await heard.until_last(f"{HAND}/state/daemon", state="offline")
    measured = {"contacts/event", "forces", "forces/20hz", "forces/50hz", "contacts", "contacts/20hz"}
    commands = {f"cmd/{verb}" for verb in VERBS} | {f"rsp/{verb}/+" for verb in VERBS} | {"rsp/ping"}
    assert check_all(heard) == ALWAYS | measured | commands
    answered = [json.loads(message.payload) for message in heard.heard if "/rsp/" in message.topic.value]
    assert {answer["ok"] for answer in answered} == {True, False}


async def test_states_of_a_link_that_was_away_are_what_the_schema_says(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    async with observe(mosquitto.url) as heard, bench.running(bench.service()):
        for _ in range(2):
            async with bench.emulated(scenario="still"):
                await heard.until_last(f"{HAND}/state/link", state="online")
            await heard.until(lambda: heard.payloads(f"{HAND}/state/link")[-1]["state"] != "online")
    assert any("last_outage" in state for state in heard.payloads(f"{HAND}/state/link"))
    check_all(heard)


async def test_a_daemon_of_a_skin_publishes_what_the_schema_says(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    scenario = bench.scenario(SHEARED)
    async with (
        bench.emulated("skin32", scenario=scenario) as emulator,
        observe(mosquitto.url) as heard,
        bench.running(bench.service("skin32", emulator.link.address)),
    ):
        await heard.until(lambda: {"onset", "release"} <= {event["event"] for event in events(heard)})
        await heard.until_count(f"{HAND}/decoded/5hz", 3)
        for verb in ("ping", "snapshot", "tare"):
            await request(Mqtt(url=mosquitto.url), "hand", verb, {})
    decoded = {"signals", "signals/5hz", "decoded", "decoded/5hz", "decoded/summary", "decoded/summary/20hz"}
    assert check_all(heard) >= ALWAYS | decoded | {"contacts", "contacts/event", "rsp/ping/+", "rsp/tare/+"}
