"""The configurations of docs/examples/dashboards for Telegraf and Node-RED, on messages of the contract.

`make test-dashboards` installs Node-RED in build/dashboards. Debian has no package of Telegraf:
json_v2.go reads its configuration instead, with the library that Telegraf reads paths with.
"""

import asyncio
import json
import os
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
from brokers import Mosquitto, free_port

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.message_examples import EXAMPLES
from resonator_daemon.mqtt.payloads import Condition, Status

HERE = Path(__file__).parent
TOOLS = HERE.parents[1] / "build" / "dashboards"
EXAMPLES_DIR = HERE.parents[1] / "docs" / "examples" / "dashboards"
TELEGRAF = tomllib.loads((EXAMPLES_DIR / "telegraf.conf").read_text())
FLOW = (EXAMPLES_DIR / "node-red.json").read_text()
GO = {"GO111MODULE": "off", "GOPATH": "/usr/share/gocode", "GOCACHE": str(TOOLS / "go-cache")}


def test_every_word_has_a_number() -> None:
    numbers = {
        mapping["fields"][0]: mapping["value_mappings"] for mapping in TELEGRAF["processors"]["enum"][0]["mapping"]
    }
    assert {name: set(words) for name, words in numbers.items()} == {"state": set(Condition), "status": set(Status)}
    assert all(len(set(words.values())) == len(words) and -1 not in words.values() for words in numbers.values())


def telegraf(topic: str, *payloads: dict[str, Any]) -> list[Any]:
    """Return what Telegraf makes of each message: metrics, those without fields left out, with numbers of words."""
    (consumer,) = (
        each for each in TELEGRAF["inputs"]["mqtt_consumer"] if aiomqtt.Topic(topic).matches(each["topics"][0])
    )
    lines = [json.dumps({"json_v2": consumer["json_v2"], "payload": json.dumps(payload)}) for payload in payloads]
    command = ("go", "run", "-p", "1", str(HERE / "json_v2.go"))
    done = subprocess.run(
        command, input="\n".join(lines), env=os.environ | GO, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    results = [json.loads(line) for line in done.stdout.splitlines()]
    for metrics in results:
        assert isinstance(metrics, list), metrics
        metrics[:] = [metric for metric in metrics if metric["fields"]]
        for metric in metrics:
            for parsing in consumer.get("topic_parsing", ()):
                tags = zip(parsing["tags"].split("/"), topic.split("/"), strict=True)
                metric["tags"] |= {tag: level for tag, level in tags if tag != "_"}
            for mapping in TELEGRAF["processors"]["enum"][0]["mapping"]:
                word = metric["fields"].get(mapping["fields"][0])
                if word is not None:
                    metric["fields"][mapping["dest"]] = mapping["value_mappings"].get(word, mapping["default"])
    return results


@pytest.mark.dashboards
def test_telegraf_makes_points_of_forces_and_contacts() -> None:
    forces, contacts = EXAMPLES["Forces"], EXAMPLES["Contacts"]
    full, empty = telegraf("resonator/left-index/forces/20hz", forces, forces | {"sites": []})
    assert empty == []
    (point,) = full
    assert (point["name"], point["time"]) == ("resonator_force", "1789000000000000000")
    assert point["tags"] == {"plate": "left-index", "site": "7"}
    assert (point["fields"]["force_newton"], point["fields"]["status_number"]) == (1.234, 0)

    (contact,) = contacts["contacts"]
    two = [contact, contact | {"id": 13, "site": 8, "force_newton": [0.1, 0.2, 2.0], "status": "settling"}]
    first, second = telegraf("resonator/left-index/contacts/20hz", contacts | {"contacts": two})[0]
    assert first["tags"] == {"plate": "left-index", "site": "7", "contact": "12"}
    assert second["tags"] == {"plate": "left-index", "site": "8", "contact": "13"}
    assert first["fields"].keys() == {"status", "status_number", "x_m", "y_m"} | {
        "force_z_newton",
        "noise_z_newton",
        "systematic_newton",
    }
    assert (first["fields"]["x_m"], first["fields"]["y_m"]) == (0.0012, -0.0034)
    assert [second["fields"][f"force_{axis}_newton"] for axis in "xyz"] == [0.1, 0.2, 2.0]
    assert second["fields"]["status_number"] == 1


@pytest.mark.dashboards
def test_telegraf_makes_points_of_health_and_states() -> None:
    health = EXAMPLES["Health"]
    lossless, lossy = telegraf("resonator/left-index/health", health, health | {"lost": {"link_gap": 3, "damaged": 1}})
    assert lossless[0]["fields"].keys() == {"frame_rate_hz", "clock_drift_ppm", "cpu_percent", "rss_mb", "uptime_s"}
    assert lossy[0]["fields"] == lossless[0]["fields"] | {"lost_link_gap": 3, "lost_damaged": 1}

    state = EXAMPLES["State"]
    ((known,), (unknown,)) = telegraf("resonator/left-index/state/link", state, state | {"state": "of a later version"})
    assert known["tags"] == {"plate": "left-index", "part": "link"}
    assert known["fields"] == {"state": "waiting", "state_number": 3, "reason_code": "no_such_port"}
    assert (known["time"], unknown["fields"]["state_number"]) == ("", -1)


@pytest.mark.dashboards
async def test_node_red_shows_forces_above_the_threshold(tmp_path: Path, mosquitto: Mosquitto) -> None:
    port = Mqtt(url=mosquitto.url).port
    (tmp_path / "flow.json").write_text(FLOW.replace('"1883"', f'"{port}"'))
    settings = {"uiHost": "127.0.0.1", "uiPort": free_port(), "httpAdminRoot": False, "flowFile": "flow.json"}
    (tmp_path / "settings.js").write_text(f"module.exports = {json.dumps(settings)};")
    program = TOOLS / "node_modules" / "node-red" / "red.js"
    node_red = await asyncio.create_subprocess_exec(
        "node", program, "--userDir", tmp_path, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    lines: list[str] = []

    async def until(end: str) -> None:
        assert node_red.stdout is not None
        while not lines or end not in lines[-1]:
            line = await node_red.stdout.readline()
            assert line, lines
            lines.append(line.decode().rstrip())

    def contacts(*newtons: float | None) -> str:
        return json.dumps({"name": "left", "contacts": [{"force_newton": [None, None, force]} for force in newtons]})

    try:
        async with asyncio.timeout(60), aiomqtt.Client("127.0.0.1", port) as client:
            await client.publish("resonator/left/contacts/20hz", contacts(7.0), qos=1, retain=True)
            await until("pressed hard")
            for newtons in ((4.9,), (), (None, 5.25), (None,), (1.0, 9.5)):
                await client.publish("resonator/left/contacts/20hz", contacts(*newtons), qos=1)
            await until("9.5")
    finally:
        node_red.terminate()
        await node_red.communicate()
    shown = [line.rpartition(" ")[2] for line in lines if "pressed hard" in line]
    assert shown == ["7", "5.25", "9.5"], lines
    assert not any("error" in line.lower() for line in lines)
