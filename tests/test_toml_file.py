"""Reading TOML: what a message says of the file, the line and the key."""

from pathlib import Path

import pytest

from resonator_daemon.errors import ConfigError
from resonator_daemon.toml_file import Number, Table, load_model, read_toml, shown


class Leaf(Table):
    depth_mm: Number = 1.0


class Branch(Table):
    leaves: tuple[Leaf, ...] = ()
    width_mm: Number = 1.0


class Tree(Table):
    branches: tuple[Branch, ...] = ()
    trunk: Leaf = Leaf()


def messages(tmp_path: Path, data: bytes) -> list[str]:
    path = tmp_path / "tree.toml"
    path.write_bytes(data)
    with pytest.raises(ConfigError) as caught:
        load_model(Tree, read_toml(path))
    return [message.removeprefix(str(path)) for message in caught.value.messages]


def test_lines_are_found_in_nested_arrays_of_tables(tmp_path: Path) -> None:
    text = b"""\
[[branches]]
[[branches.leaves]]
depth_mm = 1
[[branches]]  # the second
width_mm = "a"
[[branches.leaves]]
[[branches.leaves]]
  "depth_mm" = "b"
[trunk]
depth_mm = [
  1,
]
"""
    assert messages(tmp_path, text) == [
        ":5: branches[1].width_mm: got 'a'; must be a valid number",
        ":8: branches[1].leaves[1].depth_mm: got 'b'; must be a valid number",
        ":10: trunk.depth_mm: got [1]; must be a valid number",
    ]


def test_a_dotted_key_and_an_inline_table_have_the_line_of_their_first_word(tmp_path: Path) -> None:
    assert messages(tmp_path, b'\ntrunk.depth_mm = "a"\n')[0].startswith(":2: trunk.depth_mm: got 'a'")
    assert messages(tmp_path, b'\n\r\ntrunk = {depth_mm = "a"}\n')[0].startswith(":3: trunk.depth_mm: got 'a'")


def test_a_quoted_key_cannot_break_the_line(tmp_path: Path) -> None:
    assert messages(tmp_path, b'"a\\nb" = 1\n') == [': "a\\nb": unknown key; allowed: branches, trunk']


def test_a_table_that_is_none(tmp_path: Path) -> None:
    assert messages(tmp_path, b"trunk = 5\n") == [":1: trunk: got 5; must be a table of keys"]
    assert messages(tmp_path, b"[branches]\n")[0].startswith(":1: branches: got a table; must be a valid tuple")


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"a = 1\nb = \n", ":2: not TOML: Invalid value (at line 2, column 5)"),
        (b"a = 1\n[b\n", ":2: not TOML: Expected ']' at the end of a table declaration (at line 2, column 3)"),
        (b"a = 1\na = 2\n", ":2: not TOML: Cannot overwrite a value (at line 2, column 6)"),
        (b"a = [\n1,\n", ":3: not TOML: Invalid value (at end of document)"),
        (b"a = 1\nb = '\xff'\n", ":2: not UTF-8: byte 0xff; save the file as UTF-8"),
        (b"a = " + b"9" * 5000, ":1: not TOML: Exceeds the limit"),
        (b"a = " + b"[" * 100_000, ":1: not TOML: "),
    ],
)
def test_what_is_no_toml(tmp_path: Path, data: bytes, expected: str) -> None:
    (message,) = messages(tmp_path, data)
    assert message.startswith(expected)


def test_a_missing_file_a_directory_and_an_impossible_path(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.toml: no such file"):
        read_toml(tmp_path / "gone.toml")
    with pytest.raises(ConfigError, match="not a regular file"):
        read_toml(tmp_path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_toml(Path("a\0b"))
    with pytest.raises(ConfigError, match="cannot be read"):
        read_toml(tmp_path / ("x" * 5000))


def test_values_are_shown_short_and_without_a_password() -> None:
    assert shown("mqtt://ann:se/cr@t@host:1") == "'mqtt://***@host:1'"
    assert shown(["mqtt://ann:secret@host"]) == "['mqtt://***@host']"
    assert shown({"a": 1}) == "a table"
    assert shown(list(range(12))) == "[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ...]"
    assert len(shown("x" * 1000)) == 120
    assert shown(10**5000) == "a huge number"
    assert shown("a\nb") == "'a\\nb'"
