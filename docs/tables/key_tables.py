"""Tables of keys and words in docs/reference, and examples of messages, from the models.

`python docs/tables/key_tables.py` writes them.

A table follows a comment that names its models, as `<!-- keys: Header, Measured -->`; inherited keys are left out. An
example is the JSON block of the section that is named after its model.
"""

import json
import re
from pathlib import Path

from pydantic.fields import FieldInfo

from resonator_daemon.base.errors import FAILURES
from resonator_daemon.mqtt import payloads
from resonator_daemon.mqtt.message_examples import EXAMPLES
from resonator_daemon.mqtt.units import unit_of
from resonator_daemon.mqtt.verbs import ERRORS

PAGES = [
    Path(__file__).parents[1] / "reference" / f"{name}.md"
    for name in ("mqtt-topics", "mqtt-commands", "mqtt-delivery", "words")
]
WIDTH = 130
EXAMPLE = re.compile(r"(^## (\w+)\n(?:(?!^## |^```).*\n)*```json\n)(?:.*\n)*?(```)", re.MULTILINE)
KEYS = re.compile(r"(<!-- (keys|words|errors): ([\w, ]+) -->\n\n)(?:\|.*\n)*\n*")


def with_tables(page: str) -> str:
    """Return the page with each table as the models have it."""
    make = {"keys": table_of_keys, "words": table_of_words, "errors": table_of_errors}
    page = KEYS.sub(lambda found: f"{found[1]}{make[found[2]](found[3].split(', '))}\n", page)
    return EXAMPLE.sub(lambda found: f"{found[1]}{_wrapped(EXAMPLES[found[2]])}\n{found[3]}", page)


def table_of_keys(names: list[str]) -> str:
    rows = ["| key | unit | meaning |", "| --- | --- | --- |"]
    for name in names:
        model = getattr(payloads, name)
        own = (key for key in model.model_fields if key in model.__annotations__)
        rows += [_row(f"`{key}`", unit_of(key) or "", _meaning(model.model_fields[key])) for key in own]
    return "\n".join(rows) + "\n"


def _meaning(field: FieldInfo) -> str:
    return ("optional; " if field.exclude_if else "") + (field.description or "")


def _row(*cells: str) -> str:
    return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"


def _wrapped(example: object) -> str:
    """Return an example in lines that end between two values."""
    lines = [""]
    for part in re.split(r'(?<=, )(?=["{\[\d-])', json.dumps(example, ensure_ascii=False)):
        if len(lines[-1] + part) > WIDTH:
            lines.append(" ")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def table_of_words(names: list[str]) -> str:
    (name,) = names
    meanings = ERRORS if name == "ErrorCode" else {word: word.meaning for word in getattr(payloads, name)}
    rows = [f"| `{word}` | {meaning} |" for word, meaning in meanings.items()]
    return "\n".join(["| word | meaning |", "| --- | --- |", *rows]) + "\n"


def table_of_errors(_: list[str]) -> str:
    rows = [f"| `{code}` | {meaning} |" for code, meaning in FAILURES.items()]
    return "\n".join(["| code | meaning |", "| --- | --- |", *rows]) + "\n"


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(with_tables(page.read_text()))
