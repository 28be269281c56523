"""Lists of keys and words in docs/reference, and examples of messages, from the models.

`python docs/tables/key_tables.py` writes them.

A list follows a comment that names its models, as `<!-- keys: Header, Measured -->`; inherited keys are left out, and
so are the `SHARED` ones. An example is the JSON block of the section that is named after its model; all but the first
are without the keys of the header.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path

from pydantic.fields import FieldInfo

from resonator_daemon.base.errors import FAILURES
from resonator_daemon.mqtt import payloads
from resonator_daemon.mqtt.message_examples import EXAMPLES
from resonator_daemon.mqtt.verbs import ErrorCode

PAGES = [Path(__file__).parents[1] / "reference" / f"{name}.md" for name in ("mqtt-topics", "mqtt-commands", "states")]
WIDTH = 130
EXAMPLE = re.compile(r"(^## (\w+)\n(?:(?!^## |^```).*\n)*```json\n)(?:.*\n)*?(```)", re.MULTILINE)
KEYS = re.compile(r"(<!-- (keys|words|errors): ([\w, ]+) -->\n\n)(?:- .*\n)*\n*")
HEADER = {*payloads.Header.model_fields, "board_ticks", "board_boot_id"}
# Explained once, below "Header".
SHARED = {"status", "reason_code", "reason", "decoder_id", "noise_newton", "systematic_newton", "at_least_newton"}


def with_lists(page: str) -> str:
    """Return the page with each list as the models have it."""
    make = {"keys": list_of_keys, "words": list_of_words, "errors": list_of_errors}
    page = KEYS.sub(lambda found: f"{found[1]}{make[found[2]](found[3].split(', '))}\n", page)
    return EXAMPLE.sub(lambda found: f"{found[1]}{_wrapped(example(found[2]))}\n{found[3]}", page)


def example(name: str) -> dict[str, object]:
    """Return what the page shows of a message: the first one whole, the others without their header."""
    return {key: value for key, value in EXAMPLES[name].items() if name == "Forces" or key not in HEADER}


def list_of_keys(names: list[str]) -> str:
    models = [getattr(payloads, name) for name in names]
    fields = [(key, model.model_fields[key]) for model in models for key in model.model_fields if _own(model, key)]
    return _list((key, _meaning(field)) for key, field in fields if key not in SHARED)


def _own(model: type, key: str) -> bool:
    return key in model.__annotations__


def _meaning(field: FieldInfo) -> str:
    return ("optional; " if field.exclude_if else "") + (field.description or "")


def _list(meanings: Iterable[tuple[str, str]]) -> str:
    return "".join(f"- `{word}`: {meaning}\n" for word, meaning in meanings)


def _wrapped(message: object) -> str:
    """Return an example in lines that end between two values."""
    lines = [""]
    for part in re.split(r'(?<=, )(?=["{\[\d-])', json.dumps(message, ensure_ascii=False)):
        if len(lines[-1] + part) > WIDTH:
            lines.append(" ")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def list_of_words(names: list[str]) -> str:
    (name,) = names
    return _list((word, word.meaning) for word in (ErrorCode if name == "ErrorCode" else getattr(payloads, name)))


def list_of_errors(_: list[str]) -> str:
    return _list(FAILURES.items())


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(with_lists(page.read_text()))
