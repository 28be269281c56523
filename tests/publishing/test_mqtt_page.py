"""docs/mqtt.md says what the code does: topics, words, examples, and the subscriber in ten lines."""

import asyncio
import json
import re
import sys
from pathlib import Path
from typing import Any

import cbor2
import numpy as np
import pytest
from mqtt_helpers import Messages, publishing

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing import payloads, topics
from resonator_daemon.publishing.codec import decode, encode

PAGE = (Path(__file__).parents[2] / "docs" / "mqtt.md").read_text()
SECTIONS = dict(re.findall(r"^## (.+)\n((?:(?!^## ).*\n?)*)", PAGE, re.MULTILINE))
EXAMPLES = [
    (title, example)
    for title, section in SECTIONS.items()
    for example in re.findall(r"```json\n(.*?)```", section, re.DOTALL)
]


def rows(section: str) -> list[list[str]]:
    lines = [line for line in SECTIONS[section].splitlines() if line.startswith("| `")]
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in lines]


def test_every_topic_is_described() -> None:
    described = {path: (payload, cbor, qos, retained) for path, payload, cbor, qos, retained in rows("Topics")}
    assert described == {
        path: (
            topic.payload.__name__,
            "CBOR" if path in ("signals", "decoded") else "JSON",
            str(topic.qos),
            "yes" if topic.retained else "no",
        )
        for path, topic in topics.TOPICS.items()
    }


def test_every_payload_has_its_section() -> None:
    assert {topic.payload.__name__ for topic in topics.TOPICS.values()} <= SECTIONS.keys()


def test_every_word_is_explained() -> None:
    assert [row[0] for row in rows("State")] == list(payloads.Condition)
    assert [row[0] for row in rows("Status")] == list(payloads.Status)


@pytest.mark.parametrize(("title", "example"), EXAMPLES, ids=[title for title, _ in EXAMPLES])
def test_every_example_is_a_message_with_all_its_keys(title: str, example: str) -> None:
    message = decode(getattr(payloads, title), example.encode())
    assert json.loads(encode(message)) == json.loads(example)


def test_each_json_payload_has_an_example() -> None:
    arrays = {"Signals", "Decoded"}
    assert {title for title, _ in EXAMPLES} == {t.payload.__name__ for t in topics.TOPICS.values()} - arrays


async def test_the_ten_lines_subscribe(mosquitto) -> None:
    program, _ = re.findall(r"```python\n(.*?)```", SECTIONS["Subscribe"], re.DOTALL)
    assert len([line for line in program.splitlines() if line]) <= 10
    program = program.replace("1883", str(Mqtt(url=mosquitto.url).port))
    async with publishing(mosquitto.url) as left:
        left.publish(topics.STATE_LINK, Messages.state("online", "plugged in"))
        reader = await asyncio.create_subprocess_exec(
            sys.executable, "-c", program, stdout=asyncio.subprocess.PIPE, limit=2**20
        )
        assert reader.stdout is not None
        try:
            async with asyncio.timeout(20):
                first = await reader.stdout.readline()
                left.publish(topics.DECODED, Messages.decoded(1))
                second = await reader.stdout.readline()
        finally:
            reader.kill()
            await reader.communicate()
    assert first.startswith(b"resonator/left/state/link {")
    assert b"'reason': 'plugged in'" in first
    assert second.startswith(b"resonator/left/decoded {")
    assert b"CBORTag(40, " in second


def test_tags_become_arrays() -> None:
    _, function = re.findall(r"```python\n(.*?)```", SECTIONS["Subscribe"], re.DOTALL)
    names: dict[str, Any] = {}
    exec(function, names)
    message = Messages.decoded(1)
    read = names["to_array"](cbor2.loads(encode(message))["traction_pascal"])
    np.testing.assert_array_equal(read, message.traction_pascal)
