"""The JSON Schema of scenario files, for editors that check and complete them."""

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from simulators.scenario_file import ScenarioFile

_PLATE_KEYS = {
    "ideal": "Switches off all imperfections below that are not given; white noise, jitter and reference error stay.",
    "hysteresis_fraction": "Half width of the hysteresis, as a share of the plate's largest force.",
    "creep_fraction": "Share of a force that a site feels only after a while, and for a while afterwards.",
    "creep_time_s": "Time constant of creep.",
    "temperature_coefficient": "Relative shift per kelvin, mean over the sites; where the plate file gives none.",
    "temperature_coefficient_std": "Its standard deviation from site to site, 1/K.",
    "temperature_quadratic": "Relative shift per square of kelvin.",
    "temperature_cubic": "Relative shift per cube of kelvin.",
    "temperature_transient_s": "Relative shift for each kelvin per second.",
    "contact_time_s": "Time constant with which a site takes the temperature of what touches or surrounds it.",
    "ageing": "Relative shift for each e-fold of 1 + t / 1 day.",
    "sensitivity_scatter": "Relative standard deviation of K from touch to touch and corner; left out: the model_error "
    "of the plate file's calibration.",
    "white_fm": "Allan deviation at 1 s of the oscillators' white frequency noise.",
    "flicker_fm": "Allan deviation, at any time, of their flicker frequency noise.",
    "random_walk_fm": "Allan deviation at 1 s of their random-walk frequency noise.",
    "jitter_s": "Standard deviation of an edge at the counter's input.",
    "pilot_level_db": "Level of the pilot tone at every corner, below full scale.",
    "noise_level_db": "Level of the noise at every corner, below full scale.",
    "full_contact_newton": "Force from which on a touched site sounds at its full level.",
    "reference_error": "Relative error of the board's reference oscillator; above 0: fast.",
    "drop_rate": "Share of its frames that the board loses.",
}


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
    for key, description in _PLATE_KEYS.items():
        schema["$defs"]["Physics"]["properties"][key]["description"] = description
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema, "title": "Scenario of an emulated plate"}
