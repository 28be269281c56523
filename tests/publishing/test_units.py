"""Each number of each payload has a unit that its key tells."""

from collections.abc import Iterator
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from resonator_daemon.publishing import payloads
from resonator_daemon.publishing.units import unit_of

MODELS = [kind for kind in vars(payloads).values() if isinstance(kind, type) and issubclass(kind, BaseModel)]


def numbers(kind: type[BaseModel]) -> Iterator[str]:
    """Keys whose values are floats, arrays of them or 64-bit integers."""

    def parts(annotation: Any) -> Iterator[Any]:
        yield annotation
        for part in get_args(annotation):
            yield from parts(part)

    for key, field in kind.model_fields.items():
        of_64_bits = any(getattr(item, "lt", None) == 2**64 for item in field.metadata)
        found = [*parts(field.annotation)]
        if of_64_bits or float in found or any("float32" in str(part) for part in found):
            yield key


@pytest.mark.parametrize("kind", MODELS)
def test_each_number_has_a_unit(kind: type[BaseModel]) -> None:
    assert [key for key in numbers(kind) if unit_of(key) is None] == []
