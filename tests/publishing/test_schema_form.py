"""The schemas have the form that code generators turn into types; see resonator_daemon.publishing.json_schemas."""

import json
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import pytest
from jsonschema import Draft7Validator
from pydantic import BaseModel, Field, create_model

from resonator_daemon.publishing import asyncapi, payloads
from resonator_daemon.publishing.json_schemas import schemas_of_requests
from resonator_daemon.publishing.payloads import Header, Lost, Status
from resonator_daemon.publishing.topics import CBOR, DECODER_HEALTH, DECODER_STATE, TOPICS

DOCUMENT = json.loads(asyncapi.encoded())
SCHEMAS = DOCUMENT["components"]["schemas"]
NULL = {"type": "null"}
SCALARS = {"string", "number", "integer", "boolean", "array"}
WITH_SCHEMA = {"properties", "additionalProperties", "items", "additionalItems", "anyOf", "allOf", "not"}
PLAIN = {
    "type", "title", "description", "enum", "const", "default", "required", "dependencies", "pattern", "minimum",
    "maximum", "exclusiveMinimum", "exclusiveMaximum", "minItems", "maxItems", "minLength", "maxLength",
    "x-unit", "x-rfc8746", "tsType", "x-enum-varnames", "x-enum-descriptions",
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
    if "not" in schema:
        return "null" not in schema["not"]["type"]
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


def test_words_are_enumerations_with_their_meanings() -> None:
    enumerations = {name for name, schema in SCHEMAS.items() if "enum" in schema}
    for name in enumerations:
        told, words = SCHEMAS[name], getattr(payloads, name, ())
        assert told["type"] == "string"
        if "x-enum-descriptions" in told:
            assert told["enum"] == [str(word) for word in words]
            assert told["x-enum-varnames"] == [word.name for word in words]
            assert told["x-enum-descriptions"] == [word.meaning for word in words]
            assert all(f"`{word}`: {word.meaning}" in told["description"] for word in words)
    assert {"Status", "Condition"} <= enumerations


def test_a_choice_of_types_states_what_the_value_is_not() -> None:
    """Generators for Go make a type that decodes nothing of two types; without any they take every value."""

    class Request(BaseModel):
        id: Annotated[int, Field(ge=0)] | Annotated[str, Field(max_length=3)] | None = None

    schema = schemas_of_requests([Request])["Request"]["properties"]["id"]
    assert schema == {
        "minimum": 0,
        "maxLength": 3,
        "default": None,
        "not": {"type": ["boolean", "array", "object"]},
        "tsType": "string | number | null",
    }
    valid = Draft7Validator(schema).is_valid
    assert [valid(value) for value in (7, "abc", None)] == [True] * 3
    assert [valid(value) for value in (-1, "abcd", False, [], {})] == [False] * 5


@pytest.mark.parametrize("value", [Literal["a", "b"] | None, tuple[float | None, ...], Status | Lost])
def test_what_generators_do_not_understand_is_refused(value: Any) -> None:
    model = create_model("Request", key=(value, None))
    with pytest.raises(ValueError, match=r"null|name"):
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


def test_lost_is_in_the_header_by_reference() -> None:
    for name in ("Header", "HeaderInCbor"):
        assert SCHEMAS[name]["properties"]["lost"] == {"$ref": "#/components/schemas/Lost"}
        assert SCHEMAS[name]["properties"].keys() == Header.model_fields.keys()
