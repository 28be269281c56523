"""Reading a TOML file into a pydantic model, with every finding at once: line, key path, value and remedy."""

import json
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, Strict, ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails

from resonator_daemon.errors import ConfigError

KeyPath = tuple[int | str, ...]
Model = TypeVar("Model", bound="Table")

# TOML has types of its own: a number in quotes, or true for 1, is a mistake and not a number.
Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Count = Annotated[int, Strict()]

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_HEADER = re.compile(r"\s*(\[\[?)([A-Za-z0-9_.\-\s]+)\]\]?\s*(#.*)?")
_ASSIGNMENT = re.compile(r"""\s*["']?([A-Za-z0-9_-]+)["']?(\s*\.[\w.\s-]+)?\s*=""")
_NUMBER_WITH_UNIT = re.compile(r"\s*([-+]?[0-9][0-9_.]*(?:[eE][-+]?[0-9]+)?)\s*[A-Za-zµ/%]*\s*")
_USER_INFO = re.compile(r"//.*@")


class Table(BaseModel):
    """A table of a TOML file: its keys and no others."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True)
class TomlFile:
    """A file that is TOML; what it says is yet to be checked."""

    path: Path
    text: str
    content: dict[str, Any]


def read_toml(path: Path) -> TomlFile:
    """Read a TOML file.

    Raises
    ------
    ConfigError
        The file is missing, no regular file, not readable, not UTF-8 or not TOML.
    """
    try:
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path}: not a regular file; name a TOML file")
        data = path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give the path of an existing TOML file") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise ConfigError(f"{str(path)!r}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}:{line}: not UTF-8: byte 0x{data[error.start]:02x}; save the file as UTF-8") from None
    try:
        return TomlFile(path, text, tomllib.loads(text))
    except (ValueError, RecursionError) as error:  # ValueError: also of numbers and dates that Python cannot hold
        place = re.search(r"\(at line (\d+), column \d+\)", str(error))
        line = int(place[1]) if place else text.count("\n") + 1
        raise ConfigError(f"{path}:{line}: not TOML: {' '.join(str(error).split())}") from None


def load_model(model: type[Model], file: TomlFile, context: object = None) -> Model:
    """Check a file against a model; ConfigError carries one line for each finding, in the order of the file."""
    try:
        return model.model_validate(file.content, context=context)
    except ValidationError as error:
        lines = dict(_lines_of_keys(file.text))
        placed = [(_line_of(lines, finding["loc"]), _sentence(model, finding)) for finding in error.errors()]
    placed.sort(key=lambda item: item[0] or 0)
    raise ConfigError(*(f"{file.path}:{line}: {text}" if line else f"{file.path}: {text}" for line, text in placed))


def finding(key_path: KeyPath, value: object, sentence: str) -> InitErrorDetails:
    """Return what is wrong with the value at a key (None: it is not there), for `check_with`."""
    return {"type": "value_error", "loc": key_path, "input": value, "ctx": {"error": ValueError(sentence)}}


def check_with(findings: list[InitErrorDetails], handler: Callable[[Any], Model], raw: object) -> Model:
    """Run a wrapped pydantic check and add `findings` to its own, so that neither hides the other."""
    try:
        model = handler(raw)
    except ValidationError as error:
        details = error.errors()
        own = [InitErrorDetails(type=e["type"], loc=e["loc"], input=e["input"], ctx=e.get("ctx", {})) for e in details]
        raise ValidationError.from_exception_data(error.title, own + findings) from None
    if findings:
        raise ValidationError.from_exception_data(type(model).__name__, findings)
    return model


def nearest(word: str, allowed: Sequence[str]) -> str:
    """Return the end of a message that names the allowed words, and the one that is near."""
    near = get_close_matches(word, allowed, n=1)
    return f"allowed: {', '.join(allowed)}{f'; did you mean {near[0]}?' if near else ''}"


def shown(value: object) -> str:
    """Return a value as a message shows it: on one line, not too long, without a password."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, int) and value.bit_length() > 100:  # Python refuses to print thousands of digits
        return "a huge number"
    if isinstance(value, list | tuple):
        text = f"[{', '.join(shown(item) for item in value[:10])}{', ...' if len(value) > 10 else ''}]"
    else:
        text = _USER_INFO.sub("//***@", repr(value))
    return text if len(text) <= 120 else f"{text[:117]}..."


def _sentence(model: type[BaseModel], error: ErrorDetails) -> str:
    path, value = error["loc"], error["input"]
    where = ".".join(_shown_key(key) for key in path).replace(".[", "[")
    match error["type"]:
        case "extra_forbidden":
            return f"{where}: unknown key; {_nearest_key(model, path)}"
        case "missing":
            return f"{where}: missing; give a value"
        case "value_error":
            got = "" if value is None else f"got {shown(value)}; "  # TOML knows no null: the key is not there
            return f"{where}: {got}{error['ctx']['error']}"
        case "literal_error" if isinstance(value, str):
            allowed = error["ctx"]["expected"].replace("'", "").replace(" or ", ", ").split(", ")
            return f"{where}: got {shown(value)}; {nearest(value, allowed)}"
        case "float_type" | "int_type" if isinstance(value, str) and (alone := _NUMBER_WITH_UNIT.fullmatch(value)):
            return f"{where}: got {shown(value)}; must be a number: give it alone, as {alone[1]}; the key says its unit"
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"{where}: got {shown(value)}; must be a table of keys"
        case _:
            return f"{where}: got {shown(value)}; {error['msg'].replace('Input should be', 'must be', 1)}"


def _shown_key(key: int | str) -> str:
    if isinstance(key, int):
        return f"[{key}]"
    return key if _BARE_KEY.fullmatch(key) else json.dumps(key)


def _nearest_key(model: type[BaseModel], path: KeyPath) -> str:
    """Look in the key's own table first, then for the same key in any other table."""
    *parents, last = path
    tables = dict(_tables(model))
    table = tuple(key for key in parents if isinstance(key, str))
    own = list(tables[table].model_fields)
    if near := get_close_matches(str(last), own, n=1):
        return f"did you mean {near[0]}?"
    for other, fields in tables.items():
        if last in fields.model_fields:
            return f"did you mean {'.'.join((*other, str(last)))}?"
    return f"allowed: {', '.join(own)}"


def _tables(model: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], type[BaseModel]]]:
    """Yield every table of a file with its path; array indices are left out."""
    yield path, model
    for name, field in model.model_fields.items():
        if any(isinstance(item, PlainValidator) for item in field.metadata):
            continue  # the file holds something else here, as a name for what is loaded
        for kind in _kinds(field.annotation):
            if isinstance(kind, type) and issubclass(kind, Table):
                yield from _tables(kind, (*path, name))


def _kinds(annotation: object) -> Iterator[object]:
    yield annotation
    for argument in get_args(annotation):
        yield from _kinds(argument)


def _lines_of_keys(text: str) -> Iterator[tuple[KeyPath, int]]:
    """Yield the line of each header and key that stands first on its line."""
    lengths: dict[KeyPath, int] = {}  # of the arrays of tables so far
    table: KeyPath = ()
    for number, line in enumerate(text.split("\n"), 1):
        if header := _HEADER.fullmatch(line.rstrip("\r")):
            table = ()
            names = [name.strip() for name in header[2].split(".")]
            for depth, name in enumerate(names, 1):
                table = (*table, name)
                if depth == len(names) and header[1] == "[[":
                    lengths[table] = lengths.get(table, 0) + 1
                if table in lengths:
                    table = (*table, lengths[table] - 1)
            yield table, number
        elif key := _ASSIGNMENT.match(line):
            yield (*table, key[1]), number


def _line_of(lines: dict[KeyPath, int], path: KeyPath) -> int | None:
    return next((lines[path[:end]] for end in range(len(path), 0, -1) if path[:end] in lines), None)
