"""JSON schemas (draft 7, as AsyncAPI has them) of the payloads, from their pydantic models."""

from collections.abc import Callable, Iterable
from typing import Any, Final

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode, models_json_schema
from pydantic_core import core_schema

from resonator_daemon.publishing.units import unit_of

REF: Final = "#/components/schemas/{model}"

Schema = dict[str, Any]


class _Untitled(GenerateJsonSchema):
    """Without titles that only repeat the key."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


class _Published(_Untitled):
    """Of what the product publishes: each key is there, so that it has no default."""

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> Schema:
        return self.generate_inner(schema["schema"])

    def field_is_required(
        self, field: core_schema.ModelField | core_schema.DataclassField | core_schema.TypedDictField, total: bool
    ) -> bool:
        return True


def schemas_of_json(models: Iterable[type[BaseModel]]) -> dict[str, Schema]:
    """Return the schemas, by name, of messages that are published as JSON, and of their parts."""
    return _generate(models, "serialization", _Published)


def schemas_of_cbor(models: Iterable[type[BaseModel]]) -> dict[str, Schema]:
    """Return those of messages that are published as CBOR, once their typed arrays are read as rows of numbers.

    Numbers are numbers in CBOR, so that these are the schemas of what the models take, not of the JSON they give.
    """
    return _generate(models, "validation", _Published)


def schemas_of_requests(models: Iterable[type[BaseModel]]) -> dict[str, Schema]:
    """Return those of what others send as JSON: keys that may be left out are not required."""
    return _generate(models, "validation", _Untitled)


def _generate(
    models: Iterable[type[BaseModel]], mode: JsonSchemaMode, generator: type[GenerateJsonSchema]
) -> dict[str, Schema]:
    wanted: list[tuple[type[BaseModel], JsonSchemaMode]] = [(model, mode) for model in models]
    _, generated = models_json_schema(wanted, ref_template=REF, schema_generator=generator)
    return {name: _as_draft_7(schema) for name, schema in generated["$defs"].items()}


def _as_draft_7(schema: Any) -> Any:
    """Return a schema of draft 2020-12 in the words of draft 7, with the unit of each key as `x-unit`."""
    if isinstance(schema, list):
        return [_as_draft_7(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    converted = {key: _CONVERTED.get(key, _as_draft_7)(value) for key, value in schema.items()}
    if "prefixItems" in converted:
        items = converted.pop("prefixItems")
        converted["items"] = items[0] if all(item == items[0] for item in items) else items
    if "$ref" in converted and len(converted) > 1:  # what stands next to a reference would be passed over
        converted["allOf"] = [{"$ref": converted.pop("$ref")}]
    return converted


def _properties(properties: dict[str, Schema]) -> dict[str, Schema]:
    return {key: _with_unit(key, _as_draft_7(schema)) for key, schema in properties.items()}


def _with_unit(key: str, schema: Schema) -> Schema:
    unit = unit_of(key)
    return schema if unit is None else schema | {"x-unit": unit}


def _unchanged(value: Any) -> Any:
    return value


# Where a keyword's value is no schema: keys of an object, and data.
_CONVERTED: Final[dict[str, Callable[[Any], Any]]] = {
    "properties": _properties,
    "default": _unchanged,
    "const": _unchanged,
    "enum": _unchanged,
    "required": _unchanged,
    "x-rfc8746": _unchanged,
}
