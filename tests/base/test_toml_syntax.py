"""What is too much for the parser is refused before it, and what is like it and harmless is read."""

from pathlib import Path

import pytest

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.toml import parse_toml
from resonator_daemon.base.toml_syntax import (
    LONGEST_WORD,
    MAX_DEPTH,
    MAX_KEYS,
    MAX_LINES,
    MAX_NESTED,
    MAX_VALUES,
    excess,
)

PATH = Path("x.toml")


def refusal(text: str) -> str:
    with pytest.raises(ConfigurationError) as caught:
        parse_toml(text, PATH)
    (message,) = caught.value.messages
    return message


@pytest.mark.parametrize(
    "start",
    [
        "", "[", "  [ ", "[[", "a = {", "a = {b = 1, ", "a = [{", 'a = {b = """c"""", ', 'a = {b = """c""""", ',
        "a = {b = '''c'''', "
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["b", '"b"', "'b'", '"b\\"."', "1"])
@pytest.mark.parametrize("dot", [".", " . "])
def test_a_key_of_too_many_names_is_refused_wherever_it_is(start: str, name: str, dot: str) -> None:
    found = excess("\n" + start + dot.join([name] * (MAX_DEPTH + 1)) + "=1")
    assert found is not None
    assert found.line == 2
    assert f": {MAX_DEPTH + 1} names joined by dots, and {MAX_DEPTH} are read at most" in found.sentence
    assert excess("\n" + start + dot.join([name] * MAX_DEPTH) + "=1") is None


@pytest.mark.parametrize(
    "text",
    [
        "# " + "a." * 100,
        'a = "' + "a." * 100 + '"',
        "a = '" + "a." * 100 + "'",
        'a = """\n' + "a." * 100 + '\n"b"."c"""',
        "a = '''\n" + "a." * 100 + "\n'''",
        'a = "\\"' + "a." * 100 + '"',
        "a = [" + "1.5, -2.5, 1_0.5e-3, " * 100 + "]",
    ],
)
def test_dots_of_texts_comments_and_numbers_are_no_keys(text: str) -> None:
    parse_toml(text, PATH)


@pytest.mark.parametrize(
    ("unit", "limit", "what"),
    [
        ("\n", MAX_LINES, "lines"),
        ("a=1 ", MAX_KEYS, "keys"),
        ("1,", MAX_VALUES, "values"),
        ("{}", MAX_VALUES, "values"),
    ],
)
def test_too_many_are_refused(unit: str, limit: int, what: str) -> None:
    assert excess(unit * limit) is None
    found = excess(unit * (limit + 1))
    assert found is not None
    assert found.sentence.startswith(f"about {limit + 1} {what}, and {limit} are read at most")


@pytest.mark.parametrize("sign", ["1", "a", "-"])
def test_a_number_or_name_of_many_signs_is_refused(sign: str) -> None:
    assert excess(f"a = {sign * LONGEST_WORD}") is None
    assert refusal(f"a = {sign * (LONGEST_WORD + 1)}").startswith("x.toml:1: ")
    assert excess(f'a = "{sign * 2 * LONGEST_WORD}" # {sign * 2 * LONGEST_WORD}') is None


@pytest.mark.parametrize(
    ("opening", "closing"),
    [("[", "]"), ("[1, ", "]"), ("{a = ", "}"), ('["]", ', "]"), ('\n["a",', "]"), ("[ # ]\n", "]")],
)
def test_brackets_within_each_other_are_refused_from_a_depth_on(opening: str, closing: str) -> None:
    def nested(depth: int) -> str:
        return "\na = [\n" + opening * (depth - 1) + "1" + closing * (depth - 1) + "]"

    parse_toml(nested(MAX_NESTED), PATH)
    assert f" more than {MAX_NESTED} brackets within each other; close" in refusal(nested(MAX_NESTED + 1))
