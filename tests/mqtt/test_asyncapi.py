"""The AsyncAPI document against AsyncAPI's own schema, and messages against the document."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_messages import as_rows
from jsonschema import Draft7Validator
from sample_messages import Messages

from resonator_daemon.mqtt import asyncapi
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.message_examples import EXAMPLES
from resonator_daemon.mqtt.payloads import Decoded, Message, Signals
from resonator_daemon.mqtt.topics import TOPICS
from resonator_daemon.mqtt.verbs import VERBS

OFFICIAL = json.loads((Path(__file__).parent / "asyncapi" / "3.0.0.json").read_text())
DOCUMENT = json.loads(asyncapi.encoded())
PLATE = "{prefix}/{name}/"


def resolved(reference: str) -> Any:
    found: Any = DOCUMENT
    assert reference.startswith("#/")
    for key in reference[2:].split("/"):
        found = found[key]
    return found


def validator_of(name: str) -> Draft7Validator:
    """Return what judges messages of one kind by the document alone."""
    schema = {"$ref": f"#/components/schemas/{name}", "components": DOCUMENT["components"]}
    Draft7Validator.check_schema(DOCUMENT["components"]["schemas"][name])
    return Draft7Validator(schema)


def read(message: Message) -> Any:
    payload = encode(message)
    return json.loads(payload) if payload.startswith(b"{") else as_rows(payload)


def test_the_document_is_one_of_asyncapi_3() -> None:
    Draft7Validator.check_schema(OFFICIAL)
    assert [
        (list(error.absolute_path), error.message) for error in Draft7Validator(OFFICIAL).iter_errors(DOCUMENT)
    ] == []


def test_every_topic_is_there_with_its_delivery() -> None:
    told = {}
    for operation in DOCUMENT["operations"].values():
        if operation["action"] == "send":
            delivery = operation["bindings"]["mqtt"]
            address = resolved(operation["channel"]["$ref"])["address"]
            told[address] = (delivery["qos"], delivery["retain"], delivery.get("messageExpiryInterval"))
    deliveries = {"schema": (1, True, None), **{f"rsp/{verb}": (1, False, None) for verb in (*VERBS, "unknown")}}
    for path, topic in TOPICS.items():
        copies = (topic.slow_path,) if topic.slow_hz else ()
        deliveries |= dict.fromkeys((path, *copies), (topic.qos, topic.retained, topic.expiry_s))
    of_decoders = {"state": (1, True, 3600), "health": (0, False, 60)}
    assert told == {PLATE + path: delivery for path, delivery in deliveries.items()} | {
        f"{{prefix}}/decoder/{{id}}/{path}": delivery for path, delivery in of_decoders.items()
    }


def test_every_verb_is_there_with_its_answers() -> None:
    assert {name for name, told in DOCUMENT["operations"].items() if told["action"] == "receive"} == {
        f"cmd_{verb}" for verb in VERBS
    }
    for verb in VERBS.values():
        operation = DOCUMENT["operations"][f"cmd_{verb.name}"]
        assert resolved(operation["channel"]["$ref"])["address"] == f"{PLATE}cmd/{verb.name}"
        assert operation["x-changes"] is verb.changes
        reply, without_response_topic = operation["reply"], DOCUMENT["operations"][f"rsp_{verb.name}"]
        assert resolved(without_response_topic["channel"]["$ref"])["address"] == f"{PLATE}rsp/{verb.name}"
        for answered in (reply, without_response_topic):
            answers = [resolved(resolved(answer["$ref"])["$ref"])["name"] for answer in answered["messages"]]
            assert answers == [verb.answer.__name__, "Refusal"]
        assert (resolved(reply["channel"]["$ref"])["address"], reply["address"]["location"]) == (
            None,  # as AsyncAPI demands where the address is in the message
            "$message.header#/response_topic",
        )


def test_a_command_and_its_answer_name_what_belongs_together() -> None:
    messages = DOCUMENT["components"]["messages"]
    for verb in VERBS.values():
        for kind in (verb.request.__name__, verb.answer.__name__, "Refusal"):
            location = resolved(messages[kind]["correlationId"]["$ref"])["location"]
            assert location == "$message.payload#/id"
            assert messages[kind]["examples"][0]["payload"]["id"] == "1f9c"
            properties = resolved(messages[kind]["headers"]["$ref"])["properties"]
            assert properties.keys() >= {"correlation_data"}
            assert ("response_topic" in properties) == (kind == verb.request.__name__)


@pytest.mark.parametrize("name", sorted(DOCUMENT["components"]["messages"].keys() - {"AsyncApiDocument"}))
def test_each_message_has_examples_that_obey_its_schema(name: str) -> None:
    examples = DOCUMENT["components"]["messages"][name]["examples"]
    assert examples
    for example in examples:
        validator_of(name).validate(example["payload"])
    assert name not in EXAMPLES or examples[0] == {"payload": EXAMPLES[name]}


@pytest.mark.parametrize(("name", "model"), [("Signals", Signals), ("Decoded", Decoded)])
def test_examples_of_arrays_are_messages(name: str, model: type[Message]) -> None:
    (example,) = DOCUMENT["components"]["messages"][name]["examples"]
    arrays = {key: np.array(rows, np.float32) for key, rows in example["payload"].items() if isinstance(rows, list)}
    assert read(model.model_validate(example["payload"] | arrays)) == example["payload"]


@pytest.mark.parametrize("path", TOPICS)
def test_each_key_that_is_missing_or_of_another_type_is_found_out(path: str) -> None:
    message = read(Messages.by_path()[path])
    validator = validator_of(TOPICS[path].payload.__name__)
    for key in message:
        optional = TOPICS[path].payload.model_fields[key].exclude_if is not None
        assert validator.is_valid({name: value for name, value in message.items() if name != key}) == optional, key
        assert not validator.is_valid(message | {key: [{"of": "another type"}]}), key
    validator.validate(message | {"added_later": 1})


def own_schema(name: str) -> Any:
    """Return the schema of a message's keys without those of its header."""
    schema = DOCUMENT["components"]["schemas"][name]
    return schema["allOf"][1] if "allOf" in schema else schema


def test_arrays_are_said_to_be_typed_arrays() -> None:
    for name, key in (("Signals", "signals"), ("Decoded", "traction_pascal")):
        schema = own_schema(name)["properties"][key]
        assert schema["x-rfc8746"]["tag"] == 40
        assert schema["x-rfc8746"]["elements"] == {"tag": 85, "type": "float32, little-endian"}
    assert not validator_of("Signals").is_valid(read(Messages.signals(1)) | {"signals": [[1.0], [2.0]]})
    assert DOCUMENT["components"]["messages"]["Signals"]["contentType"] == "application/cbor"
    assert DOCUMENT["components"]["messages"]["Signals"]["bindings"]["mqtt"]["payloadFormatIndicator"] == 0


def test_each_key_has_a_description_and_numbers_have_their_unit() -> None:
    schemas = DOCUMENT["components"]["schemas"]
    assert schemas["Contact"]["properties"]["moment_std_newton_m"]["x-unit"] == "N.m"
    assert schemas["Compensation"]["properties"]["plate_kelvin_std"]["x-unit"] == "K"
    for name in (*EXAMPLES, "Signals", "Decoded", "Header", "Measured", "SiteForce", "Contact"):
        for key, told in own_schema(name)["properties"].items():
            assert told.get("description") or f"- `{key}`: " in schemas[name]["description"], (name, key)
            assert "number" not in str(told.get("type")) or "x-unit" in told, (name, key)
