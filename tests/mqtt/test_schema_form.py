"""The schemas have the form that code generators turn into types; see resonator_daemon.mqtt.json_schemas."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pytest
from pydantic import create_model

import resonator_daemon
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.mqtt import asyncapi
from resonator_daemon.mqtt.json_schemas import schemas_of_requests
from resonator_daemon.mqtt.payloads import Header, Lost, Status
from resonator_daemon.mqtt.topics import CBOR, DECODER_HEALTH, DECODER_STATE, TOPICS

DOCUMENT = json.loads(asyncapi.encoded())
SCHEMAS = DOCUMENT["components"]["schemas"]
NULL = {"type": "null"}
SCALARS = {"string", "number", "integer", "boolean", "array"}
WITH_SCHEMA = {"properties", "additionalProperties", "items", "additionalItems", "anyOf", "allOf"}
PLAIN = {
    "type", "title", "description", "enum", "const", "default", "required", "dependencies", "pattern", "minimum",
    "maximum", "exclusiveMinimum", "exclusiveMaximum", "minItems", "maxItems", "minLength", "maxLength",
    "x-unit", "x-rfc8746", "x-enum-varnames", "x-enum-descriptions",
}  # fmt: skip


def parts_of(schema: Any, path: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each schema within a schema, with the way to it."""
    if not isinstance(schema, dict):
        return
    yield path, schema
    for key in ("items", "additionalProperties"):
        for number, part in enumerate(schema[key] if isinstance(schema.get(key), list) else [schema.get(key)]):
            yield from parts_of(part, f"{path}/{key}/{number}")
    for key in ("anyOf", "allOf"):
        for number, part in enumerate(schema.get(key, [])):
            yield from parts_of(part, f"{path}/{key}/{number}")
    for key, part in schema.get("properties", {}).items():
        yield from parts_of(part, f"{path}/{key}")


PARTS = [found for name, schema in SCHEMAS.items() for found in parts_of(schema, name)]


def is_nullable(schema: dict[str, Any]) -> bool:
    return "null" in schema.get("type", ()) or NULL in schema.get("anyOf", ())


def test_only_keywords_that_generators_know_are_used() -> None:
    for path, schema in PARTS:
        assert schema.keys() <= WITH_SCHEMA | PLAIN or schema.keys() == {"$ref"}, path


def test_null_has_one_form_for_values_and_one_for_objects() -> None:
    for path, schema in PARTS:
        if isinstance(schema.get("type"), list):
            value, null = schema["type"]
            assert (null, value in SCALARS, "enum" in schema) == ("null", True, False), path
        if "anyOf" in schema:
            reference, null = schema["anyOf"]
            assert (reference.keys(), null) == ({"$ref"}, NULL), path
            assert schema["title"] == reference["$ref"].rpartition("/")[2] + "OrNull", path
    assert SCHEMAS["SiteForce"]["properties"]["force_newton"]["type"] == ["number", "null"]
    assert SCHEMAS["Contacts"]["allOf"][1]["properties"]["decoder_id"]["type"] == ["string", "null"]


def test_keys_that_may_be_null_are_no_required_ones_but_must_be_there() -> None:
    """Generators for Go make pointers of optional keys only."""
    for path, schema in PARTS:
        nullable = {key for key, value in schema.get("properties", {}).items() if is_nullable(value)}
        assert nullable.isdisjoint(schema.get("required", [])), path
        present = {key for keys in schema.get("dependencies", {}).values() for key in keys}
        assert present <= nullable, path
    assert SCHEMAS["SiteForce"]["dependencies"]["site"][0] == "force_newton"


def test_elements_that_may_be_null_have_their_places() -> None:
    for path, schema in PARTS:
        items = schema.get("items", {})
        if isinstance(items, list):
            assert schema["additionalItems"] is False, path
            assert schema["minItems"] == schema["maxItems"] == len(items), path
        else:
            assert not is_nullable(items), path
    assert len(SCHEMAS["Contact"]["properties"]["position_m"]["items"]) == 2


@pytest.mark.parametrize("value", [Literal["a", "b"] | None, int | str, tuple[float | None, ...], Status | Lost])
def test_what_generators_do_not_understand_is_refused(value: Any) -> None:
    model = create_model("Request", key=(value, None))
    with pytest.raises(ValueError, match=r"generators|null"):
        schemas_of_requests([model])


@pytest.mark.parametrize("topic", [*TOPICS.values(), DECODER_STATE, DECODER_HEALTH], ids=lambda topic: topic.path)
def test_headers_are_included_by_reference(topic: Any) -> None:
    model, schema = topic.payload, SCHEMAS[topic.payload.__name__]
    if not issubclass(model, Header):
        assert "allOf" not in schema
        return
    header = next(base for base in model.__mro__[1:] if issubclass(base, Header))
    included, own = schema["allOf"]
    name = header.__name__ + ("InCbor" if topic.content_type == CBOR else "")
    assert included == {"$ref": f"#/components/schemas/{name}"}
    assert own["properties"].keys() == model.model_fields.keys() - header.model_fields.keys()


def test_each_reason_code_occurs_in_the_product() -> None:
    package = Path(resonator_daemon.__file__).parent
    source = "".join(path.read_text() for path in package.rglob("*.py"))
    assert not [code for code in ReasonCode if f"ReasonCode.{code.name}" not in source]
