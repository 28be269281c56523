"""Where two outcomes differ by more than other processors round: integers, words and keys count exactly."""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple

TOLERANCE: Final = 1e-6  # of the largest value that its field has in the case
# What is decoded is worked out in single precision, and rounds otherwise where arrays lie otherwise in memory.
DECODED_TOLERANCE: Final = 1e-3


class Difference(NamedTuple):
    """A key and its two values."""

    key: str
    expected: object
    got: object


ABSENT: Final = "nothing"

_NOT_COMPARED: Final = {"info": ("daemon_version", "commands")}  # of another version the same is expected


class Scales:
    """The largest magnitude of each field of floats, over all messages of a topic; elements of a list are one field."""

    def __init__(self, tolerance: float = TOLERANCE) -> None:
        self._tolerance = tolerance
        self._largest: dict[str, float] = {}

    def add(self, topic: str, payload: Any) -> None:
        for field, value in _floats(topic, payload):
            self._largest[field] = max(self._largest.get(field, 0.0), abs(value))

    def tolerance(self, field: str) -> float:
        return self._tolerance * self._largest.get(field, 0.0)


def payload_differences(topic: str, expected: Any, got: Any, scales: Scales) -> Iterator[Difference]:
    """Give each key of a message that differs."""
    for key in _NOT_COMPARED.get(topic, ()):
        expected = {name: value for name, value in expected.items() if name != key}
        got = {name: value for name, value in got.items() if name != key}
    yield from _differences("", topic, expected, got, scales)


def summary_differences(expected: Mapping[str, Any], got: Mapping[str, Any]) -> list[Difference]:
    """Return each key of a summary that differs."""
    return list(_differences("", "", dict(expected), dict(got), Scales()))


def _differences(key: str, field: str, expected: Any, got: Any, scales: Scales) -> Iterator[Difference]:
    if type(expected) is not type(got):
        yield Difference(key, expected, got)
    elif isinstance(expected, dict):
        for name in dict.fromkeys((*expected, *got)):
            inner = f"{key}.{name}" if key else str(name)
            if name not in got or name not in expected:
                yield Difference(inner, expected.get(name, ABSENT), got.get(name, ABSENT))
            else:
                yield from _differences(inner, f"{field}.{name}", expected[name], got[name], scales)
    elif isinstance(expected, list):
        if len(expected) != len(got):
            yield Difference(f"{key}[]", f"{len(expected)} elements", f"{len(got)} elements")
        for number, (one, other) in enumerate(zip(expected, got, strict=False)):
            yield from _differences(f"{key}[{number}]", f"{field}[]", one, other, scales)
    elif isinstance(expected, float):
        if not math.isclose(expected, got, rel_tol=0.0, abs_tol=scales.tolerance(field)):
            yield Difference(key, expected, got)
    elif expected != got:
        yield Difference(key, expected, got)


def _floats(field: str, value: Any) -> Iterable[tuple[str, float]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _floats(f"{field}.{name}", inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _floats(f"{field}[]", inner)
    elif isinstance(value, float) and math.isfinite(value):
        yield field, value
