"""Reading TOML: what a message says of the file, the line and the key."""

import os
from pathlib import Path

import pytest

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.toml import MAX_BYTES, MAX_FINDINGS, Number, Table, load_model, read_toml


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
    with pytest.raises(ConfigurationError) as caught:
        load_model(Tree, read_toml(path))
    return [message.removeprefix(str(path)) for message in caught.value.messages]


def test_lines_are_found_in_nested_arrays_of_tables(tmp_path: Path) -> None:
    text = Path(__file__).with_name("nested_tables.toml").read_bytes()
    assert messages(tmp_path, text) == [
        ":5: branches[1].width_mm: got 'a'; must be a valid number",
        ":8: branches[1].leaves[1].depth_mm: got 'b'; must be a valid number",
        ":10: trunk.depth_mm: got [1]; must be a valid number",
    ]


def test_a_dotted_key_and_an_inline_table_have_the_line_of_their_first_word(tmp_path: Path) -> None:
    assert messages(tmp_path, b'\ntrunk.depth_mm = "a"\n')[0].startswith(":2: trunk.depth_mm: got 'a'")
    assert messages(tmp_path, b'\n\r\ntrunk = {depth_mm = "a"}\n')[0].startswith(":3: trunk.depth_mm: got 'a'")


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"a = 1\nb = \n", ":2: not TOML: Invalid value (at line 2, column 5)"),
        (b"a = 1\n[b\n", ":2: not TOML: Expected ']' at the end of a table declaration (at line 2, column 3)"),
        (b"a = 1\na = 2\n", ":2: not TOML: Cannot overwrite a value (at line 2, column 6)"),
        (b"a = [\n1,\n", ":3: not TOML: Invalid value (at end of document)"),
        (b"a = 1\nb = '\xff'\n", ":2: not UTF-8: byte 0xff; save the file as UTF-8"),
        (b"a = " + b"9" * 5000, ":1: not TOML: Exceeds the limit"),
        (b"a = " + b"[" * 100_000, ": too many brackets within each other; nest fewer"),
    ],
)
def test_what_is_no_toml(tmp_path: Path, data: bytes, expected: str) -> None:
    (message,) = messages(tmp_path, data)
    assert message.startswith(expected)


def test_what_is_no_file_of_settings_is_refused_and_not_read_to_its_end(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "huge.toml").open("wb") as file:
        file.truncate(100 << 20)
    for place, said in (
        (tmp_path / "gone.toml", "no such file"),
        (Path("a\0b"), "cannot be read"),
        (tmp_path / ("x" * 5000), "cannot be read"),
        (tmp_path, "not a regular file"),
        (tmp_path / "pipe", "not a regular file"),
        (Path("/dev/zero"), "not a regular file"),
        (tmp_path / "huge.toml", "longer than 10000000 bytes"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            read_toml(place)
    (tmp_path / "long.toml").write_bytes(b"#" * MAX_BYTES)
    assert read_toml(tmp_path / "long.toml").content == {}


def test_what_windows_programs_write(tmp_path: Path) -> None:
    path = tmp_path / "tree.toml"
    path.write_bytes("a = 1\r\nb = 'ü'\r\n".encode("utf-8-sig"))
    assert read_toml(path).content == {"a": 1, "b": "ü"}
    path.write_bytes("a = 1\r\n".encode("utf-16"))
    with pytest.raises(ConfigurationError, match=r"tree\.toml:1: not UTF-8 but UTF-16; save the file as UTF-8"):
        read_toml(path)


def test_messages_are_bounded(tmp_path: Path) -> None:
    long = "k" * 900
    text = "".join(f"{long}{number} = 1\n" for number in range(300)) + f'branches = "{long}"\n'
    told = messages(tmp_path, text.encode())
    assert len(told) == MAX_FINDINGS + 1
    assert told[0].startswith(":1: kkk")
    assert told[-1] == ": 201 more; correct the first ones first"
    assert max(map(len, told)) < 300
    assert len(messages(tmp_path, f"branches = '{long}'".encode())[0]) < 400
    for text in (f"[{long}]\n[{long}]\n", f"{long}: 1\n"):
        assert len(messages(tmp_path, text.encode())[0]) < 600


def test_a_line_of_spaces_in_a_text_takes_no_time(tmp_path: Path) -> None:
    """Looking for a key at its end would take as many steps as the square of its length."""
    text = f'"""\na.{" " * 1_000_000}\n"""\n'
    assert messages(tmp_path, f"branches = {text}".encode())[0].startswith(":1: branches: got")
