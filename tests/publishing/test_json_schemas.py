"""Schemas in the words of draft 7, which readers of AsyncAPI documents know."""

from collections.abc import Iterator
from typing import Any

import pytest
from jsonschema import Draft7Validator

from resonator_daemon.publishing.asyncapi import document

SCHEMAS = document()["components"]["schemas"]


def objects(part: Any) -> Iterator[dict[str, Any]]:
    if isinstance(part, dict):
        yield part
    for inner in part.values() if isinstance(part, dict) else part if isinstance(part, list) else ():
        yield from objects(inner)


def test_no_later_words_are_used() -> None:
    assert [part for part in objects(SCHEMAS) if part.keys() & {"prefixItems", "$defs", "$dynamicRef"}] == []


def test_nothing_stands_beside_a_reference() -> None:
    """There it would be passed over."""
    assert [part for part in objects(SCHEMAS) if "$ref" in part and len(part) > 1] == []


@pytest.mark.parametrize(
    ("pair", "valid"), [([0.1, 0.2], True), ([0.1, None], True), ([0.1], False), (["x", 0.2], False), ([0.1, 0], True)]
)
def test_pairs_are_pairs_of_numbers(pair: list[Any], valid: bool) -> None:
    assert Draft7Validator(SCHEMAS["Contact"]["properties"]["position_m"]).is_valid(pair) is valid


def test_what_is_always_published_has_no_default_and_what_may_be_left_out_of_a_request_has() -> None:
    assert "default" not in SCHEMAS["EventContact"]["properties"]["slip_margin"]
    assert "slip_margin" in SCHEMAS["EventContact"]["required"]
    assert SCHEMAS["SetWindow"]["properties"]["step_ms"]["default"] is None
    assert SCHEMAS["SetWindow"]["required"] == ["window_ms"]
