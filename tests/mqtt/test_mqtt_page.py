"""The pages about MQTT say what the code does: topics, words, examples, and the subscriber in ten lines."""

import asyncio
import json
import re
import sys
from typing import Any

import cbor2
import key_tables
import numpy as np
import pytest
from mqtt_helpers import LEFT, Messages, publishing

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import asyncapi, payloads, topics
from resonator_daemon.mqtt.codec import decode, encode
from resonator_daemon.mqtt.message_examples import EXAMPLES
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.verbs import VERBS, ErrorCode, Refusal

PAGE = "".join(page.read_text() for page in key_tables.PAGES)
SECTIONS = dict(re.findall(r"^## (.+)\n((?:(?!^## ).*\n?)*)", PAGE, re.MULTILINE))
DAEMON, EITHER = "daemon", "daemon or decoder"


def rows(section: str) -> list[list[str]]:
    lines = [line for line in SECTIONS[section].splitlines() if line.startswith("| `")]
    return [[re.sub(r"\[(.+)\]\(.+\)|`", r"\1", cell.strip()) for cell in line.strip("|").split("|")] for line in lines]


def described(topic: topics.Topic[Message]) -> list[str]:
    return [
        topic.payload.__name__,
        "CBOR" if topic.content_type == topics.CBOR else "JSON",
        str(topic.qos),
        "yes" if topic.retained else "no",
        "" if topic.expiry_s is None else f"{topic.expiry_s} s",
    ]


def test_every_topic_is_described() -> None:
    of_plates = {path: cells for path, *cells in rows("Topics") if len(cells) == 7}
    assert of_plates.pop("schema") == ["", "the contract", "JSON", "1", "yes", "", DAEMON]
    by_either = {"contacts/event", "contacts", "decoded", "decoded/summary"}
    assert of_plates == {
        path: [topic.slow_path if topic.slow_hz else "", *described(topic), EITHER if path in by_either else DAEMON]
        for path, topic in topics.TOPICS.items()
    }
    of_decoders = {path: cells for path, *cells in rows("Topics") if len(cells) == 5}
    assert of_decoders == {topic.path: described(topic) for topic in (topics.DECODER_STATE, topics.DECODER_HEALTH)}


def test_tables_of_keys_and_words_are_those_of_the_models() -> None:
    assert key_tables.with_lists(PAGE) == PAGE, "python docs/tables/key_tables.py writes them again"


def test_each_set_of_words_has_a_table() -> None:
    """Those of topics are in the table of topics."""
    sets = {name for name, schema in asyncapi.document()["components"]["schemas"].items() if "enum" in schema}
    assert sets == set(re.findall(r"<!-- words: (\w+) -->", PAGE))


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_example_is_a_message_with_all_its_keys(name: str) -> None:
    message = decode(getattr(payloads, name), json.dumps(EXAMPLES[name]).encode())
    assert json.loads(encode(message)) == EXAMPLES[name]


def test_each_json_payload_has_an_example() -> None:
    assert len(re.findall("```json", PAGE)) >= 6
    published = {*topics.TOPICS.values(), topics.DECODER_STATE, topics.DECODER_HEALTH}
    assert EXAMPLES.keys() == {topic.payload.__name__ for topic in published if topic.content_type == topics.JSON}


def test_the_tables_of_commands_and_codes_are_those_of_the_verbs() -> None:
    verbs = [cells for cells in rows("Verbs") if len(cells) == 4]
    assert [(verb, allowed) for verb, _, _, allowed in verbs] == [
        (verb.name, "by name" if verb.changes else "always") for verb in VERBS.values()
    ]
    for verb, _, request, _ in verbs:
        assert [*VERBS[verb].request.model_fields] == ["id", *re.findall(r"\w+", request.partition(":")[0])]
    codes = re.findall(r"^- `(\w+)`", SECTIONS["Refusals of commands"], re.MULTILINE)
    assert sorted(codes) == sorted(ErrorCode)


def test_the_answers_shown_are_whole() -> None:
    text = "\n".join(line for line in SECTIONS["Answers"].splitlines() if line.startswith("    "))
    shown = [json.loads(each) for each in re.findall(r"^    (\{.*?\}$)(?=\n    \{|\Z)", text, re.DOTALL | re.MULTILINE)]
    assert len(shown) >= 4
    for answer in shown:
        model = VERBS[answer["verb"]].answer if answer["ok"] else Refusal
        assert json.loads(model.model_validate_json(json.dumps(answer)).model_dump_json()) == answer


async def test_the_ten_lines_subscribe(mosquitto) -> None:
    program, function = re.findall(r"```python\n(.*?)```", SECTIONS["Subscribe"], re.DOTALL)
    assert len([line for line in program.splitlines() if line]) <= 10
    program = program.replace("1883", str(Mqtt(url=mosquitto.url).port))
    async with publishing(mosquitto.url) as left:
        left.publish(LEFT, topics.STATE_LINK, Messages.state("online", "plugged in"))
        left.retain(f"{LEFT}/decoded", encode(Messages.decoded(1)), topics.CBOR)  # for later subscribers, too
        reader = await asyncio.create_subprocess_exec(
            sys.executable, "-c", program, stdout=asyncio.subprocess.PIPE, limit=2**20
        )
        try:
            async with asyncio.timeout(20):
                at_first = sorted([await reader.stdout.readline() for _ in range(2)])  # from two connections
                left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(1))
                last = await reader.stdout.readline()
        finally:
            reader.kill()
            await reader.communicate()
    decoded, state = at_first
    assert state.startswith(b"resonator/left/state/link {")
    assert b"'reason': 'plugged in'" in state
    assert decoded.startswith(b"resonator/left/decoded {")
    assert b"CBORTag(40, " in decoded
    assert last.startswith(b"resonator/left/contacts/event {")
    names: dict[str, Any] = {}
    exec(function, names)
    message = Messages.decoded(1)
    read = names["to_array"](cbor2.loads(encode(message))["traction_pascal"])
    np.testing.assert_array_equal(read, message.traction_pascal)
