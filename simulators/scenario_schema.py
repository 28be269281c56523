"""The JSON Schema of scenario files, for editors that check and complete them."""

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from simulators.scenario_file import ScenarioFile


class _TomlSchema(GenerateJsonSchema):
    """TOML has no null: what has no value is left out."""

    def field_title_should_be_set(self, schema: object) -> bool:
        return False  # it would be the key again

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        if schema.get("default") is None or isinstance(schema["default"], BaseModel):
            return self.generate_inner(schema["schema"])
        return super().default_schema(schema)


def scenario_schema() -> dict[str, Any]:
    """Return the schema, with a description of every table and key."""
    schema = ScenarioFile.model_json_schema(schema_generator=_TomlSchema)
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema, "title": "Scenario of an emulated plate"}
