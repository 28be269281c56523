"""Reader of TOML files into pydantic models; reports all findings at once with line, key path, value and remedy."""

import codecs
import json
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar, get_args
from urllib.parse import SplitResult, urlsplit

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, Strict, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, InitErrorDetails

from resonator_daemon.base.errors import ConfigurationError, meaning_of
from resonator_daemon.base.toml_syntax import advice

KeyPath = tuple[int | str, ...]
Model = TypeVar("Model", bound="Table")

# TOML has types of its own: a number in quotes, or true for 1, is a mistake and not a number.
Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Count = Annotated[int, Strict()]

MAX_BYTES: Final = 10_000_000  # the most tones that fit into a frame are 8 MB of plate file
MAX_FINDINGS: Final = 100

_LONGEST_SHOWN: Final = 120
_DEEPEST_SHOWN: Final = 5
_LONGEST_REASON: Final = 300
_LONGEST_HEAD: Final = 1000  # of a line, in which a key or header is looked for: longer ones are values, or no TOML
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_HEADER = re.compile(r"\s*(\[\[?)([A-Za-z0-9_.\-\s]+)\]\]?\s*(#.*)?")
_ASSIGNMENT = re.compile(r"""\s*+["']?([A-Za-z0-9_-]++)["']?(\s*+\.[\w.\s-]++)?\s*+=""")  # linear: + gives nothing back
_NUMBER_WITH_UNIT = re.compile(r"\s*([-+]?[0-9][0-9_.]*(?:[eE][-+]?[0-9]+)?)\s*[A-Za-zµ/%]*\s*")
_USER_INFO = re.compile(r"//.*@")


class Table(BaseModel):
    """Table of a TOML file; unknown keys are faults."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True)
class TomlFile:
    """Parsed TOML file, not yet checked."""

    path: Path | str
    text: str
    content: dict[str, Any]


def read_toml(path: Path) -> TomlFile:
    """Read a TOML file.

    Raises
    ------
    ConfigurationError
        The file is missing, no regular file, longer than MAX_BYTES, not readable, not UTF-8 or not TOML.
    """
    try:
        if path.exists() and not path.is_file():  # opening a pipe would wait for ever, /dev/zero never ends
            raise ConfigurationError(f"{named(path)}: not a regular file; name a TOML file")
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        near = path.with_name(f"{path.name}.toml")
        remedy = f"did you mean {named(near)}?" if near.is_file() else "give the path of an existing TOML file"
        raise ConfigurationError(f"{named(path)}: no such file; {remedy}") from None
    except PermissionError:
        raise ConfigurationError(f"{named(path)}: permission denied; let the user who runs this read it") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        reason = meaning_of(error)
        raise ConfigurationError(
            f"{named(path)}: cannot be read: {reason}; name a TOML file that can be read"
        ) from None
    if len(data) > MAX_BYTES:
        raise ConfigurationError(f"{named(path)}: longer than {MAX_BYTES} bytes; name a TOML file of settings")
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ConfigurationError(f"{named(path)}:1: not UTF-8 but UTF-16; save the file as UTF-8")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigurationError(
            f"{named(path)}:{line}: not UTF-8: byte 0x{data[error.start]:02x}; save the file as UTF-8"
        ) from None
    return parse_toml(text.removeprefix("\ufeff"), path)


def parse_toml(text: str, path: Path | str) -> TomlFile:
    """Parse the text of a TOML file; `path` names it in messages.

    Raises
    ------
    ConfigurationError
        It is not TOML, or is nested too deeply.
    """
    try:
        return TomlFile(path, text, tomllib.loads(text))
    except RecursionError:
        raise ConfigurationError(f"{named(path)}: too many brackets within each other; nest fewer") from None
    except ValueError as error:  # also of numbers and dates that Python cannot hold
        place = re.search(r"\(at line (\d+), column (\d+)\)", str(error))
        number, column = (int(place[1]), int(place[2])) if place else (text.count("\n") + 1, 1)
        remedy = advice((text + "\n").split("\n")[number - 1], column, str(error))
        reason = "; ".join(filter(None, (" ".join(str(error).split())[:_LONGEST_REASON], remedy)))
        raise ConfigurationError(f"{named(path)}:{number}: not TOML: {reason}") from None


def load_model(model: type[Model], file: TomlFile, context: object = None) -> Model:
    """Check a file against a model; ConfigurationError carries one line for each finding, in the order of the file.

    Of more than MAX_FINDINGS the rest is counted.
    """
    try:
        return model.model_validate(file.content, context=context)
    except ValidationError as error:
        lines = dict(_lines_of_keys(file.text))
        placed = [(_line_of(lines, finding["loc"]), finding) for finding in error.errors()]
    placed.sort(key=lambda item: item[0] or 0)
    name = named(file.path)
    findings = [f"{name}:{f'{line}:' if line else ''} {_sentence(model, item)}" for line, item in placed[:MAX_FINDINGS]]
    if len(placed) > MAX_FINDINGS:
        findings.append(f"{name}: {len(placed) - MAX_FINDINGS} more; correct the first ones first")
    raise ConfigurationError(*findings)


def finding(key_path: KeyPath, value: object, sentence: str) -> InitErrorDetails:
    """Return a fault of the value at a key (None: the key is missing), for `check_with`."""
    return {"type": "value_error", "loc": key_path, "input": value, "ctx": {"error": ValueError(sentence)}}


def check_with(findings: list[InitErrorDetails], handler: Callable[[Any], Model], raw: object) -> Model:
    """Run a wrapped pydantic check and add `findings` to its own."""
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


def named(path: Path | str) -> str:
    """Return a path as a message shows it: on one line, without signs that a terminal takes as commands."""
    text = str(path)
    return text if text.isprintable() else repr(text)


def shown(value: object, depth: int = 0) -> str:
    """Return a value as a message shows it: on one line, not too long or deep, without a password."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, int) and value.bit_length() > 100:  # Python refuses to print thousands of digits
        return "a huge number"
    if isinstance(value, list | tuple) and depth == _DEEPEST_SHOWN:
        return "[...]"
    if isinstance(value, list | tuple):
        text = f"[{', '.join(shown(item, depth + 1) for item in value[:10])}{', ...' if len(value) > 10 else ''}]"
    else:
        text = _USER_INFO.sub("//***@", repr(value))
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 3]}..."


def _sentence(model: type[BaseModel], error: ErrorDetails) -> str:
    path, value = error["loc"], error["input"]
    where = ".".join(_shown_key(key) for key in path).replace(".[", "[")
    match error["type"]:
        case "extra_forbidden":
            return f"{where}: unknown key; {_nearest_key(model, path)}"
        case "missing":
            return f"{where}: missing; give {_meaning(model, path)}"
        case "value_error":
            got = "" if value is None else f"got {shown(value)}; "  # TOML has no null: the key is missing
            return f"{where}: {got}{error['ctx']['error']}"
        case "literal_error" if isinstance(value, str):
            allowed = error["ctx"]["expected"].replace("'", "").replace(" or ", ", ").split(", ")
            return f"{where}: got {shown(value)}; {nearest(value, allowed)}"
        case "string_type" if isinstance(value, int | float) and not isinstance(value, bool):
            return f"{where}: got {shown(value)}; must be text: {_as_text(model, path, value)}"
        case "bool_type":
            return f"{where}: got {shown(value)}; must be true or false, without quotes"
        case "tuple_type":
            example = f", as [{shown(value)}]" if isinstance(value, str) else ""
            return f"{where}: got {shown(value)}; must be a list{example}"
        case "float_type" | "int_type" if isinstance(value, str) and (alone := _NUMBER_WITH_UNIT.fullmatch(value)):
            return (
                f"{where}: got {shown(value)}; must be a number: give it alone, as {alone[1]}; the key names its unit"
            )
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"{where}: got {shown(value)}; must be a table of keys"
        case _:
            sentence = re.sub(r"^(Input|String|List|Tuple) should (be|have|match)", r"must \2", error["msg"])
            return f"{where}: got {shown(value)}; {sentence}"


def _shown_key(key: int | str) -> str:
    if isinstance(key, int):
        return f"[{key}]"
    short = key if len(key) <= _LONGEST_SHOWN else f"{key[: _LONGEST_SHOWN - 3]}..."
    return short if _BARE_KEY.fullmatch(key) else json.dumps(short)


def _meaning(model: type[BaseModel], path: KeyPath) -> str:
    """Return the description and an example of a key, if its model has them."""
    field = _field(model, path)
    if field is None or field.description is None:
        return "a value"
    example = _example(model, path)
    return field.description + (f", as {example}" if example else "")


def _as_text(model: type[BaseModel], path: KeyPath, value: object) -> str:
    """Return the quoted form of a number if the key expects text and accepts that value."""
    field, quoted = _field(model, path), f'put it in quotes, as "{shown(value)}"'
    if field is None or not field.examples:
        return quoted
    wanted: Any = Annotated[field.annotation, Field(), *field.metadata]  # Field(): some have no metadata
    try:
        TypeAdapter(wanted).validate_python(str(value))
    except ValidationError:
        return f"as {_example(model, path)}"
    return quoted


def _example(model: type[BaseModel], path: KeyPath) -> str | None:
    """Return a line of a file with the key; None if its model has no example."""
    field = _field(model, path)
    return f"{path[-1]} = {json.dumps(field.examples[0], ensure_ascii=False)}" if field and field.examples else None


def _field(model: type[BaseModel], path: KeyPath) -> FieldInfo | None:
    *parents, last = path
    table = dict(_tables(model)).get(tuple(key for key in parents if isinstance(key, str)))
    return table.model_fields.get(str(last)) if table else None


def _nearest_key(model: type[BaseModel], path: KeyPath) -> str:
    """Look for the same key in any other table first, then for a similar one in its own."""
    *parents, last = path
    table = tuple(key for key in parents if isinstance(key, str))
    tables = dict(_tables(model))
    for other, fields in tables.items():
        if last in fields.model_fields:
            place = "" if other else " It belongs above the first [table]"
            return f"did you mean {'.'.join((*other, str(last)))}?{place}"
    own = list(tables[table].model_fields)
    if near := get_close_matches(str(last).lower(), own, n=1):
        return f"did you mean {near[0]}?"
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
    for number, whole_line in enumerate(text.split("\n"), 1):
        line = whole_line[:_LONGEST_HEAD]
        if header := _HEADER.fullmatch(line.rstrip("\r")):
            table = ()
            names = [name.strip() for name in header[2].split(".")]
            for depth, name in enumerate(names, 1):
                table = (*table, name)
                if depth == len(names) and header[1] == "[[":
                    lengths[table] = lengths.get(table, 0) + 1
                    if depth == lengths[table] == 1:
                        yield table, number  # of what is wrong with all of the array
                if table in lengths:
                    table = (*table, lengths[table] - 1)
            yield table, number
        elif key := _ASSIGNMENT.match(line):
            yield (*table, key[1]), number


def _line_of(lines: dict[KeyPath, int], path: KeyPath) -> int | None:
    return next((lines[path[:end]] for end in range(len(path), 0, -1) if path[:end] in lines), None)


_PART_MAX: Final = 63  # characters between the dots of a name (RFC 1035, section 2.3.4)


def split_url(url: str) -> SplitResult:
    """Split a URL; ValueError, without a password in it, where host or port cannot be read."""
    try:
        parts = urlsplit(url)
        readable = url.isprintable() and " " not in url and parts.port != 0
    except ValueError:
        readable = False
    if readable:
        _check_host(parts.hostname or "")
        return parts
    advice = "; write signs such as # / @ in a password as %23 %2F %40" if "@" in url else ""
    raise ValueError(f"host and port (1 to 65535) cannot be read{advice}")


def _check_host(host: str) -> None:
    """Raise ValueError for a name that no resolver takes: the look-up itself would fail in another way."""
    names = host.removesuffix(".").split(".") if host else []
    try:
        encoded = [name if name.isascii() else name.encode("idna") for name in names]
    except UnicodeError:
        encoded = [""]
    if not all(0 < len(name) <= _PART_MAX for name in encoded):
        raise ValueError(f"no host is called {host!r}: each part between dots has 1 to {_PART_MAX} letters or digits")
