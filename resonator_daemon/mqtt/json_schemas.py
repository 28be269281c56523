"""JSON schemas (draft 7, as AsyncAPI has them) of the payloads, from their pydantic models.

Their form is one that code generators (modelina, json-schema-to-typescript) turn into types without loss:

- A value that may be null has the type `[T, "null"]`, or is `anyOf` a `$ref` and null. Its key is in `dependencies`
  instead of `required`: generators make pointers of optional keys only.
- A set of words is an `enum` of its own, by name.
- What has a name is referred to by a bare `$ref`; the meaning of the key is then in the description of the object.
- Messages include their header by `allOf`.
"""

from collections.abc import Collection, Iterable
from typing import Any, Final

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode, models_json_schema
from pydantic_core import core_schema

from resonator_daemon.mqtt.payload_types import Header, unit_of

REF: Final = "#/components/schemas/{model}"

Schema = dict[str, Any]

_NULL: Final = {"type": "null"}
_DATA: Final = ("default", "const", "enum", "required", "x-rfc8746")  # keywords whose value is no schema


class _Untitled(GenerateJsonSchema):
    """Without titles that only repeat the key."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


class _Published(_Untitled):
    """Of what the product publishes: each key is there, without a default, or is left out where it has no value."""

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> Schema:
        return self.generate_inner(schema["schema"])

    def field_is_required(
        self, field: core_schema.ModelField | core_schema.DataclassField | core_schema.TypedDictField, total: bool
    ) -> bool:
        return "serialization_exclude_if" not in field


def schemas_of_json(models: Iterable[type[BaseModel]]) -> dict[str, Schema]:
    """Return the schemas, by name, of messages that are published as JSON, and of their parts and headers."""
    return _generate(models, "serialization", _Published)


def schemas_of_cbor(models: Iterable[type[BaseModel]]) -> dict[str, Schema]:
    """Return those of messages that are published as CBOR, once their typed arrays are read as rows of numbers.

    Numbers are numbers in CBOR, so that these are the schemas of what the models take, not of the JSON they give.
    The headers' names end in `InCbor`.
    """
    return _generate(models, "validation", _Published, header_suffix="InCbor")


def schemas_of_requests(models: Iterable[type[BaseModel]]) -> dict[str, Schema]:
    """Return those of what others send as JSON: keys that may be left out are not required."""
    return _generate(models, "validation", _Untitled)


def _generate(
    models: Iterable[type[BaseModel]],
    mode: JsonSchemaMode,
    generator: type[GenerateJsonSchema],
    *,
    header_suffix: str = "",
) -> dict[str, Schema]:
    models = tuple(models)
    headers = {header for model in models for header in _headers_of(model)}
    every = dict.fromkeys((*models, *sorted(headers, key=lambda header: header.__name__)))
    wanted: list[tuple[type[BaseModel], JsonSchemaMode]] = [(model, mode) for model in every]
    references, generated = models_json_schema(wanted, ref_template=REF, schema_generator=generator)
    classes = {reference["$ref"].rpartition("/")[2]: model for (model, _), reference in references.items()}
    schemas: dict[str, Schema] = {}
    for name, schema in generated["$defs"].items():
        model = classes.get(name)
        included = _headers_of(model) if model is not None else ()
        published = name + header_suffix if model in headers else name
        inherited = included[0].model_fields.keys() if included else ()
        component = _component(published, schema, inherited)
        if included:
            about = {key: component.pop(key) for key in ("title", "description")}
            header = {"$ref": REF.format(model=included[0].__name__ + header_suffix)}
            component = about | {"allOf": [header, component]}
        schemas[published] = component
    return schemas


def _headers_of(model: type[Any]) -> tuple[type[Header], ...]:
    """Return the headers that a message includes, the one with most keys first."""
    return tuple(base for base in model.__mro__[1:] if issubclass(base, Header))


def _component(name: str, schema: Schema, inherited: Collection[str]) -> Schema:
    """Return the schema of a named type, without the keys that its header has."""
    component: Schema = _as_draft_7(schema) | {"title": name}
    if "properties" not in component:
        return component
    keys, required = component["properties"], component.pop("required", [])
    certain = [key for key in required if not _may_be_null(keys[key])]
    own = {key: value for key, value in keys.items() if key not in inherited}
    referring = {key: value.pop("description") for key, value in own.items() if "$ref" in value and len(value) > 1}
    about = [component.get("description", ""), *(f"- `{key}`: {meaning}" for key, meaning in referring.items())]
    component |= {"description": "\n".join(about), "properties": own}
    if own_certain := [key for key in certain if key in own]:
        component["required"] = own_certain
    if uncertain := [key for key in required if key in own and key not in certain]:
        if not certain:
            raise ValueError(f"{name}: needs a key that is never null")
        component["dependencies"] = {certain[0]: uncertain}
    return component


def _as_draft_7(schema: Any) -> Any:
    """Return a schema of draft 2020-12 in the words of draft 7, with the unit of each key as `x-unit`."""
    if isinstance(schema, list):
        return [_as_draft_7(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    converted: Schema = {
        key: _properties(value) if key == "properties" else value if key in _DATA else _as_draft_7(value)
        for key, value in schema.items()
    }
    if "prefixItems" in converted:
        items = converted.pop("prefixItems")
        converted["items"] = items[0] if all(item == items[0] for item in items) else items
    if "anyOf" in converted:
        converted = _nullable(converted)
    if converted.get("type") == "array":
        converted = _array(converted)
    return converted


def _may_be_null(schema: Schema) -> bool:
    return "null" in schema.get("type", ()) or _NULL in schema.get("anyOf", ())


def _nullable(schema: Schema) -> Schema:
    """Return the form of a value or null."""
    value: Schema
    value, *others = (part for part in schema["anyOf"] if part != _NULL)
    if others or value.keys() & {"enum", "const"}:
        raise ValueError(f"{schema}: types of which generators make one that decodes nothing; give the words a name")
    if "$ref" in value:
        return schema | {"title": f"{value['$ref'].rpartition('/')[2]}OrNull"}
    outer = {key: part for key, part in schema.items() if key != "anyOf"}
    if _may_be_null(value):  # an optional key of a number that may be unknown
        return value | outer
    return value | outer | {"type": [value["type"], "null"]}


def _array(schema: Schema) -> Schema:
    """Return an array whose elements may be null as a list of them: generators lose it in an array of any length."""
    items = schema.get("items", {})
    if isinstance(items, list) or not _may_be_null(items):
        return schema
    length = schema.get("minItems")
    if length is None or length != schema.get("maxItems"):
        raise ValueError(f"{schema}: an array of values that may be null must have a fixed length")
    return schema | {"items": [items] * length, "additionalItems": False}


def _properties(properties: dict[str, Schema]) -> dict[str, Schema]:
    return {key: _with_unit(key, _as_draft_7(schema)) for key, schema in properties.items()}


def _with_unit(key: str, schema: Schema) -> Schema:
    unit = unit_of(key)
    return schema if unit is None or "$ref" in schema else schema | {"x-unit": unit}
