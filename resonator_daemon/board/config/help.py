"""Reference of the configuration file: its JSON Schema, and a description of each key."""

import json
import textwrap
from collections.abc import Iterator
from difflib import get_close_matches
from typing import Any, Final, NamedTuple

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from resonator_daemon.base.errors import UsageError
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.values import takes_live

_UNITS: Final = {"ms": "milliseconds", "minutes": "minutes", "mb": "megabytes, 10^6 bytes"}
_ROOM_MIN: Final = 20  # columns for text: a terminal that is narrower wraps by itself
_LIMITS: Final = {
    "exclusiveMinimum": "above {}",
    "minimum": "at least {}",
    "exclusiveMaximum": "below {}",
    "maximum": "at most {}",
    "maxLength": "at most {} characters",
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


class Key(NamedTuple):
    """Description of a key: type, unit, default, limits, meaning."""

    path: str
    meaning: str
    kind: str
    unit: str  # empty where there is none
    default: str  # as TOML has it; empty where there is none
    limits: str  # empty where there are none
    examples: tuple[str, ...]
    required: bool
    live: bool  # whether a reload applies it, without a restart


def config_schema() -> dict[str, Any]:
    """Return the JSON Schema of configuration files, for editors that check and complete TOML."""
    schema = Config.model_json_schema(schema_generator=_TomlSchema)
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema, "title": "Configuration of resonatord"}


def config_keys() -> tuple[Key, ...]:
    """Return every key of a configuration, in the order of the models."""
    schema = config_schema()
    return tuple(_keys(schema, schema["$defs"], ""))


def explained(path: str) -> tuple[Key, ...]:
    """Return the key of this path, as `mqtt.url`, or all keys of a table; an empty path means the file.

    Raises
    ------
    UsageError
        There is neither; the nearest is named.
    """
    keys = config_keys()
    found = tuple(key for key in keys if not path or key.path == path or key.path.startswith(f"{path}."))
    if not found:
        alike = [key.path for key in keys if key.path.rpartition(".")[2] == path.rpartition(".")[2]]
        alike += get_close_matches(path, [key.path for key in keys], n=1)
        near = f"did you mean {alike[0]}? All" if alike else "all"
        raise UsageError(f"no key is called {path!r}; {near} of them: resonatord config explain")
    return found


def key_list(keys: tuple[Key, ...], columns: int | None) -> str:
    """Return a line for each key, wrapped to so many columns, or not at all."""
    longest = max(len(key.path) for key in keys)
    return "".join(_wrapped(f"{key.path:<{longest}}  ", key.meaning, columns) for key in keys)


def explanation(key: Key, columns: int | None) -> str:
    """Return the description of a key in a few lines, wrapped to so many columns, or not at all."""
    rows = [("type", f"{key.kind}, in {key.unit}" if key.unit else key.kind)]
    rows += [("default", "none: it must be given")] if key.required else []
    rows += [("default", key.default)] if key.default else []
    rows += [("range", key.limits)] if key.limits else []
    rows += [("example", f"{key.path.rpartition('.')[2]} = {example}") for example in key.examples]
    rows += [("reload", "takes it" if key.live else "does not take it: restart the daemon")]
    lines = [_wrapped("", f"{key.path}: {key.meaning}", columns)]
    return "".join(lines + [_wrapped(f"  {name:<8} ", text, columns) for name, text in rows])


def _wrapped(head: str, text: str, columns: int | None) -> str:
    """Return the text behind its head; further lines have the same indent."""
    if columns is None:
        return f"{head}{text}\n"
    room = max(columns - len(head), _ROOM_MIN)
    parts = textwrap.wrap(text, room, break_long_words=False, break_on_hyphens=False)
    return "\n".join(f"{head if not at else ' ' * len(head)}{part}" for at, part in enumerate(parts)) + "\n"


def _keys(table: dict[str, Any], tables: dict[str, Any], path: str) -> Iterator[Key]:
    for name, schema in table["properties"].items():
        if reference := schema.get("$ref"):
            yield from _keys(tables[reference.rpartition("/")[2]], tables, f"{path}{name}.")
            continue
        unit = next((unit for ending, unit in _UNITS.items() if name.endswith(f"_{ending}")), "")
        default = json.dumps(schema["default"], ensure_ascii=False) if "default" in schema else ""
        examples = tuple(json.dumps(example, ensure_ascii=False) for example in schema.get("examples", ()))
        yield Key(
            path + name,
            schema["description"],
            _kind(schema),
            unit,
            default,
            _limits(schema),
            examples or ((default,) if default else ()),
            name in table.get("required", ()),
            takes_live(path + name),
        )


def _kind(schema: dict[str, Any]) -> str:
    if "anyOf" in schema:
        return " or ".join(_kind(one) for one in schema["anyOf"])
    if "const" in schema:
        return json.dumps(schema["const"])
    if "enum" in schema:
        return " or ".join(json.dumps(word) for word in schema["enum"])
    if schema["type"] == "array":
        return f"list of {_kind(schema['items'])}"
    return {"boolean": "true or false", "number": "number", "string": "text"}[schema["type"]]


def _limits(schema: dict[str, Any]) -> str:
    sources = [schema, *schema.get("anyOf", ())]
    found = ((words, one[limit]) for one in sources for limit, words in _LIMITS.items() if limit in one)
    return ", ".join(words.format(f"{value:.10g}") for words, value in found)
